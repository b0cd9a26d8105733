"""A camera has a mass: what is known of its positions before anything is measured, once the map's unit is.

A keyframe that hangs on its neighbour by a few anchors, which nothing else sees, has no scale of its own: images allow
it to be metres away, a tenth of a second before.
"""

import numpy as np

from edgeslam_torch.types import FloatArray

ACCELERATION_M_S2 = 10.0
"""Standard deviation of the acceleration along each axis: a g. Hands and drones of seven recordings have .2 to 1.7,
6.6 at most. Counted thirty times in flight, as the rest of telemetry is, it is 1.8: still too weak to move what images
hold."""
LONGEST_S = 0.5
"""Time between two pictures beyond which a camera may have stopped and set off again."""


def inertia(stamps_s: FloatArray, metres: float) -> FloatArray | None:
    """Information about positions from the limits of acceleration.

    Args:
        stamps_s: Increasing stamps of the pictures ``(K,)``.
        metres: Metres per map unit.

    Returns:
        ``(3 K, 3 K)`` [1/unit^2] of the positions stacked as ``(K, 3)``: any even motion costs nothing. None where
        no three pictures follow each other closely.

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
    sigma = ACCELERATION_M_S2 / metres * 0.5 * (before + after)
    whitened = change / sigma[:, None]
    return np.asarray(np.kron(whitened.T @ whitened, np.eye(3)))
