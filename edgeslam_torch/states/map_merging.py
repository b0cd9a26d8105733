"""Merging of submaps and loop closure between two frames; the current pose is transformed with the map."""

import math
from dataclasses import replace

import numpy as np

from edgeslam_torch.atlas.atlas import Atlas, Join
from edgeslam_torch.atlas.loops import Closure
from edgeslam_torch.atlas.submap_heading import Turned
from edgeslam_torch.atlas.submap_scale import Rescaled
from edgeslam_torch.estimation.output_frame import OutputFrame
from edgeslam_torch.geometry import se3, sim3
from edgeslam_torch.states.system import System
from edgeslam_torch.types import FloatArray

_COUNTED: dict[type, str] = {Join: "joined", Closure: "loops_closed", Rescaled: "rescaled", Turned: "turned"}
"""Keys of these events in the summary."""


class MapMerging:
    """Runs the atlas while the map is not in use elsewhere."""

    def __init__(self, system: System, atlas: Atlas) -> None:
        self.system = system
        self.atlas = atlas
        self._piece: int | None = None
        """Submap whose scale is published."""
        self._left: int | None = None
        """Submap of the previous frame."""

    def update(self, stamp_s: float = math.inf) -> str:
        """Merge submaps and close loops that the newest keyframes connect; returns a description, empty without any.

        Args:
            stamp_s: Stamp of the present frame.
        """
        if self.system.mapping.busy:
            return ""
        words = []
        if len(self.system.map.begun) > 1:
            self._notice_return()
            before = self._last()
            if (aligned := self.atlas.align(stamp_s, self.system.scale_ratio())) is not None:
                self._follow(aligned, *before)
                words.append(str(aligned))
        while (change := self._once(stamp_s)) is not None:
            words.append(str(change))
        return "; ".join(words)

    def enter(self, piece: int) -> None:
        """Publish in the metric scale of the camera's submap where an earlier flight has determined it."""
        system = self.system
        if piece == self._piece:
            return
        self._piece = piece
        known = self.atlas.known_scale.get(piece)
        system.fusion.metres.remember(known)
        if known is None:
            return
        published = replace(system.published, upright=True)
        if published.scale != known.value or published.offset.any() or not np.array_equal(published.R, np.eye(3)):
            published = OutputFrame(known.value, revision=published.revision + 1, guessed=False, upright=True)
        system.published = published

    def _notice_return(self) -> None:
        """When the camera returns to an earlier submap, the one that it left is complete: compare both again."""
        piece = self.system.map.piece_of(self.system.log.records[-1].keyframe_id)
        returned = self._left is not None and piece < self._left
        self._left = piece
        if returned and self.atlas.is_divided:
            self.atlas.search_again()

    def finish(self) -> None:
        """Query every keyframe once more if there are several submaps, since these have grown."""
        if self.atlas.is_divided:
            self.atlas.search_all_again()
        self.update()

    def _last(self) -> tuple[int, int, FloatArray]:
        """Reference keyframe of the newest frame, its submap, and its pose."""
        last = self.system.log.records[-1].keyframe_id
        return last, self.system.map.piece_of(last), self.system.map.pose_of(last)

    def _once(self, stamp_s: float) -> Join | Closure | None:
        if self.atlas.is_up_to_date or not self.system.log.records:
            return None
        before = self._last()
        change = self.atlas.update(stamp_s)
        if change is not None:
            self._follow(change, *before)
        return change

    def _follow(self, change: Join | Closure | Rescaled | Turned, last: int, piece: int, T_k_w: FloatArray) -> None:
        """Transform the current pose and the metric scale with a map that changed after the newest frame."""
        system = self.system
        T_c_k = system.motion.T_c_w @ se3.inverse(T_k_w)
        scale = change.growth(piece, last)
        T_c_k[:3, 3] *= scale
        system.motion.transform(T_c_k @ system.map.pose_of(last), scale)
        if isinstance(change, Rescaled):  # the scale estimate without new measurements is that of this submap
            system.fusion.metres.follow(math.log(scale))
        system.compare_depths_again()
        system.fusion.revise(*system.log.poses())
        # Poses published before belong to the map before the change.
        system.published = replace(system.published, revision=system.published.revision + 1)
        if isinstance(change, Turned):
            system.submap_uncertainty.turned(change.piece, change.sigma_rad)
        elif isinstance(change, Join):
            system.submap_uncertainty.moved(change.moved, sim3.scale_of(change.S))
        kind = _COUNTED[type(change)]
        system.events[kind] = system.events.get(kind, 0) + 1
