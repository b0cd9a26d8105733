"""Live view of a flight in rerun: pose, occupancy, path, exits and decisions."""

import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch.flying.flight_controller import Moment
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.types import FloatArray
from edgeslam_torch.viewer.rerun_viewer import open_recording

_EVERY_S = 0.5
"""Interval between updates of the occupancy: some thousand cells each."""
_FREE, _SOLID, _WAY, _FLOWN, _EXIT = (120, 170, 200, 60), (60, 60, 60), (217, 145, 43), (47, 127, 184), (200, 64, 47)


class FlightView:
    """A listener of `Navigator.open` that shows each control cycle.

    Args:
        name: Title of the recording.
        save: ``.rrd`` file to write instead of starting the viewer's window.

    Raises:
        MissingPackageError: If rerun is not installed.
        OutputError: If ``save`` cannot be written.
    """

    def __init__(self, name: str, save: Path | None = None) -> None:
        plain = re.sub(r"[^\w-]+", "_", f"edgeslam_flight_{name}")  # rerun warns of slashes and colons
        self._rr, self._stream = open_recording(plain, save, True, _layout)
        self._began_s = self._shown_s = math.nan
        self._flown: list[FloatArray] = []
        self._revision, self._words = 0, ""

    def __call__(self, moment: Moment) -> None:
        """Show a control cycle."""
        state, rr = moment.state, self._rr
        if math.isnan(self._began_s):
            self._began_s = state.stamp_s
        if state.revision != self._revision:  # the earlier path is at another scale
            self._revision, self._flown = state.revision, []
        self._stream.set_time("time", duration=state.stamp_s - self._began_s)
        self._flown.append(state.p_w.copy())
        nose = 0.3 * np.array([math.cos(state.yaw_rad), math.sin(state.yaw_rad), 0.0])
        self._log("world/drone", rr.Arrows3D(origins=[state.p_w], vectors=[nose], colors=[_FLOWN]))
        speed = float(np.linalg.norm(state.velocity_w))
        self._log("speed/flown", rr.Scalars(speed))
        self._log(
            "speed/wanted", rr.Scalars(math.hypot(moment.order.command.forward_m_s, moment.order.command.left_m_s))
        )
        self._log("speed/cruising", rr.Scalars(moment.pilot.limits.speed_m_s))
        self._say(moment)
        if not state.stamp_s - self._shown_s < _EVERY_S:  # also the first time
            self._shown_s = state.stamp_s
            self._surroundings(moment)

    def close(self) -> None:
        """Flush and end the recording."""
        self._stream.flush()
        self._stream.disconnect()

    def _say(self, moment: Moment) -> None:
        """Phase, danger and reason, when they change."""
        words = f"{moment.phase}; {moment.order.command.why}"
        if moment.order.danger:
            words += f"; {moment.order.danger}"
        if words != self._words:
            self._words = words
            self._log("reasons", self._rr.TextLog(words))

    def _surroundings(self, moment: Moment) -> None:
        rr, pilot, height = self._rr, moment.pilot, float(moment.state.p_w[2])
        self._log("world/flown", rr.LineStrips3D([np.array(self._flown)], colors=[_FLOWN]))
        way = pilot.way_w
        self._log("world/way", rr.LineStrips3D([_raised(way, height)] if len(way) > 1 else [], colors=[_WAY]))
        if pilot.layer is not None:
            half = 0.5 * pilot.layer.cell_m
            for name, mask, colour in (("free", pilot.layer.free, _FREE), ("solid", pilot.layer.solid, _SOLID)):
                cells = _cells(pilot.layer, mask, height)
                sizes = np.tile([half, half, 0.02], (len(cells), 1))
                boxes = rr.Boxes3D(centers=cells, half_sizes=sizes, colors=[colour], fill_mode="solid")
                self._log(f"world/{name}", boxes)
        lines = []
        for exit_ in pilot.exits.exits:
            across = 0.5 * exit_.width_m * np.array([-exit_.normal_w[1], exit_.normal_w[0], 0.0])
            lines.append(np.array([exit_.centre_w - across, exit_.centre_w + across]))
        self._log("world/exits", rr.LineStrips3D(lines, colors=[_EXIT], radii=[0.03]))

    def _log(self, entity: str, what: object) -> None:
        self._stream.log(entity, what)


def _cells(layer: Layer, mask: np.ndarray, height_m: float) -> FloatArray:
    return _raised(layer.centres(np.argwhere(mask)), height_m)


def _raised(p_w: FloatArray, height_m: float) -> FloatArray:
    return np.column_stack([p_w, np.full(len(p_w), height_m)])


def _layout(rrb: Any) -> Any:
    """Layout of the window."""
    beside = rrb.Vertical(
        rrb.TimeSeriesView(origin="speed", name="speed: flown, wanted, cruising [m/s]"),
        rrb.TextLogView(origin="reasons", name="phase and reason"),
    )
    scene = rrb.Spatial3DView(origin="world", name="space and path")
    return rrb.Blueprint(rrb.Horizontal(scene, beside, column_shares=[6, 4]), collapse_panels=True)
