"""Progress of a run: loading, frames with pose and way, last refinement, writing."""

import math
from bisect import bisect_right
from typing import TYPE_CHECKING

import numpy as np

from edgeslam_torch.terminal.progress import Progress
from edgeslam_torch.types import FloatArray, Frame, SlamOutput, TelemetrySample

if TYPE_CHECKING:
    from edgeslam_torch.readers.source import Source

_STEP = 0.1
"""Least distance between points of the way [published unit]."""


class RunProgress(Progress):
    """A run's progress, a listener of `edgeslam_torch.run.run`: loading, frames, last refinement, writing."""

    def __init__(self, what: str, redraw: bool | None = None) -> None:
        super().__init__(what, redraw=redraw)
        self._source: Source | None = None
        self._output: SlamOutput | None = None
        self._path = PathLength()

    def follow(self, source: "Source") -> None:
        """The frames come from here."""
        self._source = source
        self.phase("loading the system")

    def on_frame(self, frame: Frame, output: SlamOutput, slam: object) -> None:
        """Called after each frame; loading the network is not part of the rate."""
        if self._output is None:
            self.phase("", None if self._source is None else self._source.length, "frame")
            self.words = self._where
        self._output = output
        self._path.add(output)
        self.advance()

    def on_last_frame(self, slam: object) -> None:
        """Called before the last refinement."""
        self.words = str
        self.phase("last refinement")

    def on_finish(self, slam: object) -> None:
        """Called after it."""
        self.phase("writing the results")

    def _where(self) -> str:
        output, source = self._output, self._source
        assert output is not None
        silent_s = getattr(source, "silent_s", 0.0)
        waits = f"no picture for {silent_s:.0f} s" if silent_s >= 1.0 else ""
        telemetry = [] if source is None else source.telemetry
        before = bisect_right(telemetry, output.stamp_s, key=lambda sample: sample.stamp_s)
        height = height_text(telemetry[before - 1]) if before else ""
        return ", ".join(part for part in (waits, status_words(output), height, self._path.text(output)) if part)


class PathLength:
    """The way flown, without the jitter of a pose that stands."""

    def __init__(self) -> None:
        self.flown = 0.0
        self._last: FloatArray | None = None
        self._unit, self._piece = 1.0, 0

    def add(self, output: SlamOutput) -> None:
        """Go to the next pose; a revision of the unit applies to the way so far, another piece begins elsewhere."""
        here = output.T_w_c[:3, 3]
        if output.unit != self._unit:
            self.flown *= output.unit / self._unit
            self._unit, self._last = output.unit, None
        if self._last is None or output.piece != self._piece:
            self._last, self._piece = here, output.piece
        elif (step := float(np.linalg.norm(here - self._last))) > _STEP:
            self.flown, self._last = self.flown + step, here

    def text(self, output: SlamOutput) -> str:
        """Position with its standard deviation, and the way."""
        unit = " m" if output.metric else ""
        sigma = 0.0 if output.health is None else output.health.home_sigma
        unsure = f" +- {sigma:.2g}{unit}" if 0 < sigma < math.inf else ""
        return f"{position_text(output.T_w_c[:3, 3])}{unit}{unsure}, {self.flown:.1f}{unit} travelled"


def position_text(p_w: FloatArray) -> str:
    """Position for a status line."""
    return "at ({:.2f}, {:.2f}, {:.2f})".format(*p_w)


def height_text(sample: TelemetrySample) -> str:
    """Height above the floor, or above the take-off, for a status line."""
    height_m = sample.tof_m if math.isfinite(sample.tof_m) else sample.height_m
    return f"height {height_m:.2f} m" if math.isfinite(height_m) else ""


def status_words(output: SlamOutput) -> str:
    """Status of one frame with its reason and the uncertainty of its metres, short."""
    reason = f" ({output.reason})" if output.reason else ""
    health = "" if output.health is None else f", {output.health}"
    return f"{output.status}{reason}, {output.inliers} inliers{health}"
