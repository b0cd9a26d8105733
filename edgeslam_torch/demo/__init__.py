"""The demo: a simulated drone in a simulated house, processed by the whole pipeline and compared with the truth."""

from edgeslam_torch.demo.flight import CAMERAS, WORLDS, DemoSettings, Recorded, record
from edgeslam_torch.demo.judging import SCORE, DemoResult, MapAccuracy, map_accuracy, run_and_judge

__all__ = [
    "CAMERAS",
    "SCORE",
    "WORLDS",
    "DemoResult",
    "DemoSettings",
    "MapAccuracy",
    "Recorded",
    "map_accuracy",
    "record",
    "run_and_judge",
]
