"""Metric monocular SLAM with a semi-dense edge map; see README.md.

Importing this package imports next to nothing: the names below load on first use. Type checkers and editors read
them in ``__init__.pyi``.
"""

import importlib
import os

# Threads of OpenMP (torch) and OpenBLAS (numpy, scipy) spin while they wait; with a busy second core that turns a 26 ms
# inference into 419 ms and a 1 ms factorisation into 100 ms (docs/decisions/24-threads-and-seeds.md). All must be set
# before these libraries are first imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("GOMP_SPINCOUNT", "0")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

_HERE = os.path.dirname(os.path.realpath(__file__))
_ROOT = os.path.dirname(_HERE)
if not os.path.exists(os.path.join(_HERE, "losses", "__init__.py")) and os.path.exists(f"{_ROOT}/pyproject.toml"):
    # A zip download or a Windows checkout has no symbolic links to models/, losses/, train/, eval/.
    __path__.append(_ROOT)

__version__ = "0.3.0"

_LAZY = {
    "Camera": "edgeslam_torch.geometry.camera",
    "EdgeSlam": "edgeslam_torch.slam",
    "EdgeSlamError": "edgeslam_torch.errors",
    "Frame": "edgeslam_torch.types",
    "ImuModel": "edgeslam_torch.imu",
    "ImuReadings": "edgeslam_torch.imu",
    "SlamConfig": "edgeslam_torch.config",
    "SlamOutput": "edgeslam_torch.types",
    "TelemetrySample": "edgeslam_torch.types",
    "load_camera": "edgeslam_torch.geometry.camera_file",
    "open_source": "edgeslam_torch.readers.source",
    "run": "edgeslam_torch.run",
}
__all__ = [
    "Camera",
    "EdgeSlam",
    "EdgeSlamError",
    "Frame",
    "ImuModel",
    "ImuReadings",
    "SlamConfig",
    "SlamOutput",
    "TelemetrySample",
    "__version__",
    "load_camera",
    "open_source",
    "run",
]


def __getattr__(name: str) -> object:
    if name in _LAZY:
        module = importlib.import_module(_LAZY[name])
        globals()[name] = module if name == "run" else getattr(module, name)  # that module is the function as well
        return globals()[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
