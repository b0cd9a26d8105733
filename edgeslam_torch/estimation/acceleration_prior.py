"""Prior on camera positions from bounded acceleration, for maps with metric scale.

A keyframe that shares few anchors with its neighbours has no reliable scale of its own: the images alone allow a
position metres away a tenth of a second earlier.
"""

import numpy as np

from edgeslam_torch.noise import IMPLAUSIBLE_ACCELERATION_M_S2
from edgeslam_torch.types import FloatArray

LONGEST_S = 0.5
"""Maximum time between two frames; over longer gaps the camera may have stopped and restarted."""


def inertia(stamps_s: FloatArray, metres: float) -> FloatArray | None:
    """Information on positions from the acceleration prior.

    Args:
        stamps_s: Increasing stamps of frames ``(K,)``.
        metres: Metres per map unit.

    Returns:
        ``(3 K, 3 K)`` [1/unit^2] of the positions stacked as ``(K, 3)``; uniform motion has no cost. None without three
        frames in close succession.

    >>> import numpy as np
    >>> still = inertia(np.array([0.0, 0.1, 0.3]), metres=2.0)
    >>> even = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 3.0, 0.0, 0.0])
    >>> float(even @ still @ even) < 1e-9, still.shape
    (True, (9, 9))
    """
    gaps = np.diff(stamps_s)
    first = np.flatnonzero((gaps[:-1] < LONGEST_S) & (gaps[1:] < LONGEST_S))
    if len(first) == 0:
        return None
    before, after = gaps[first], gaps[first + 1]
    change = np.zeros((len(first), len(stamps_s)))  # of the velocity [units/s]
    rows = np.arange(len(first))
    change[rows, first] = 1.0 / before
    change[rows, first + 1] = -1.0 / before - 1.0 / after
    change[rows, first + 2] = 1.0 / after
    sigma = IMPLAUSIBLE_ACCELERATION_M_S2 / metres * 0.5 * (before + after)
    whitened = change / sigma[:, None]
    return np.asarray(np.kron(whitened.T @ whitened, np.eye(3)))
