"""Data of a flight for aligning its map with telemetry, shared by the parts of `MotionFusion`."""

from dataclasses import dataclass

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.telemetry.delay import DelaySearch
from edgeslam_torch.estimation.telemetry.sensor_validation import SensorGate
from edgeslam_torch.estimation.telemetry.track import TelemetryTrack
from edgeslam_torch.estimation.telemetry.visual_memory import VisualMemory


@dataclass(frozen=True, slots=True)
class Remembered:
    """Messages and poses, the delay between them, and which readings are usable."""

    config: FusionConfig
    track: TelemetryTrack
    memory: VisualMemory
    delay: DelaySearch
    trust: SensorGate

    @property
    def delay_s(self) -> float:
        """Video delay behind telemetry [s]: configured, estimated, or the default while unknown."""
        return self.delay.delay.value_s

    @property
    def delay_sigma_s(self) -> float:
        """Standard deviation of `delay_s`; infinite while unknown, 0 when configured."""
        return self.delay.delay.sigma_s
