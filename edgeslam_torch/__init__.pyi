from edgeslam_torch.config import SlamConfig as SlamConfig
from edgeslam_torch.errors import EdgeSlamError as EdgeSlamError
from edgeslam_torch.geometry.camera import Camera as Camera
from edgeslam_torch.geometry.camera_file import load_camera as load_camera
from edgeslam_torch.imu import ImuModel as ImuModel
from edgeslam_torch.imu import ImuReadings as ImuReadings
from edgeslam_torch.readers.source import open_source as open_source
from edgeslam_torch.run import run as run
from edgeslam_torch.slam import EdgeSlam as EdgeSlam
from edgeslam_torch.types import Frame as Frame
from edgeslam_torch.types import SlamOutput as SlamOutput
from edgeslam_torch.types import TelemetrySample as TelemetrySample

__version__: str
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
