"""Metric monocular SLAM with a semi-dense edge map; see README.md.

Importing this package imports next to nothing: the names below load on first use.
"""

import importlib
import os

TYPE_CHECKING = False
if TYPE_CHECKING:  # as type checkers read it; `typing` itself takes longer to load than all the rest here
    from edgeslam_torch.config import SlamConfig
    from edgeslam_torch.errors import EdgeSlamError
    from edgeslam_torch.geometry.camera import Camera
    from edgeslam_torch.readers.source import open_source
    from edgeslam_torch.slam import EdgeSlam
    from edgeslam_torch.types import Frame, SlamOutput, TelemetrySample

# torch's OpenMP threads spin while they wait; with a busy second core that turns a 26 ms inference
# into 419 ms (docs/decisions/0025-threads-and-seeds.md). Both must be set before torch is first imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("GOMP_SPINCOUNT", "0")

_HERE = os.path.dirname(os.path.realpath(__file__))
_ROOT = os.path.dirname(_HERE)
if not os.path.exists(os.path.join(_HERE, "losses", "__init__.py")) and os.path.exists(f"{_ROOT}/pyproject.toml"):
    # A zip download or a Windows checkout has no symbolic links to models/, losses/, train/, eval/.
    __path__.append(_ROOT)

__version__ = "0.2.0"

_LAZY = {
    "Camera": "edgeslam_torch.geometry.camera",
    "EdgeSlam": "edgeslam_torch.slam",
    "EdgeSlamError": "edgeslam_torch.errors",
    "Frame": "edgeslam_torch.types",
    "SlamConfig": "edgeslam_torch.config",
    "SlamOutput": "edgeslam_torch.types",
    "TelemetrySample": "edgeslam_torch.types",
    "open_source": "edgeslam_torch.readers.source",
}
__all__ = [
    "Camera",
    "EdgeSlam",
    "EdgeSlamError",
    "Frame",
    "SlamConfig",
    "SlamOutput",
    "TelemetrySample",
    "__version__",
    "open_source",
]


if not TYPE_CHECKING:  # a type checker takes the imports above, and says so where a name is wrong

    def __getattr__(name):
        if name in _LAZY:
            globals()[name] = getattr(importlib.import_module(_LAZY[name]), name)
            return globals()[name]
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

    def __dir__():
        return sorted({*globals(), *__all__})
