"""Merging of submaps and loop closure between two frames; the current pose is transformed with the map."""

from dataclasses import replace

import numpy as np

from edgeslam_torch.atlas.atlas import Atlas, MapChange
from edgeslam_torch.atlas.relaxation import move
from edgeslam_torch.estimation.scale.submap_scale import SubmapScale
from edgeslam_torch.geometry import se3, sim3
from edgeslam_torch.states.system import System
from edgeslam_torch.types import FloatArray


class MapMerging:
    """Runs the atlas while the map is not in use elsewhere."""

    def __init__(self, system: System, atlas: Atlas) -> None:
        self.system = system
        self.atlas = atlas
        self._piece: int | None = None
        """Submap whose scale is published."""

    def update(self) -> str:
        """Merge submaps and close loops that the newest keyframes connect; returns a description, empty without any."""
        system, changes = self.system, []
        if system.mapping.busy or not system.log.records:
            return ""
        piece = system.map.piece_of(system.log.records[-1].keyframe_id)
        if piece in system.fusion.submaps:
            self._scale_submap(piece, system.fusion.submaps[piece])
        while not self.atlas.is_up_to_date and (found := self._followed()):
            changes.append(found)
        return "; ".join(map(str, changes))

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
        published = replace(system.published, upright=True, is_earlier=True)
        if published.scale != known.value or not np.array_equal(published.R, np.eye(3)):
            sigma = known.sigma / known.value
            published = replace(published, scale=known.value, R=np.eye(3), revision=published.revision + 1, sigma=sigma)
        system.published = published

    def finish(self) -> None:
        """Query every keyframe once more if there are several submaps, since these have grown."""
        if self.atlas.is_divided:
            self.atlas.search_all_again()
        self.update()
        largest = self.system.log.support().largest()
        fusion = self.system.fusion
        if largest is not None and largest != fusion.piece:  # its heading and metres are the result's
            fusion.enter(largest)
            fusion.revise(*self.system.log.poses())
        if largest in fusion.submaps and fusion.submaps[largest].is_known:
            del fusion.submaps[largest]

    def _scale_submap(self, piece: int, known: SubmapScale) -> None:
        """Bring the newest frame's submap to the map's unit, about the place where it began, whenever sensors
        contradict that it is: a change of the unit instead would move that place, where the map before it had the
        camera."""
        system, last, growth = self.system, self.system.log.records[-1].keyframe_id, known.growth
        start = self.atlas.graph.starts.get(piece)
        if start is None:
            return
        # Growth counts once, also if the sensors cannot measure the grown submap again.
        system.fusion.submaps[piece] = known.grown()
        if known.is_settled:
            del system.fusion.submaps[piece]
        if growth == 1.0:
            return
        T_c_k = system.motion.T_c_w @ se3.inverse(system.map.pose_of(last))
        began = se3.inverse(system.map.pose_of(start.keyframe_id))[:3, 3]
        S = sim3.compose(growth, np.eye(3), (1.0 - growth) * began)
        members = [id for id in system.map.keyframes if system.map.piece_of(id) == piece]
        self._follow(last, T_c_k, move(system.map, self.atlas.edges, system.log, dict.fromkeys(members, S))[last])
        system.events["scaled"] = system.events.get("scaled", 0) + 1

    def _followed(self) -> MapChange | None:
        """Change the map by the next merge or loop."""
        system = self.system
        last = system.log.records[-1].keyframe_id
        T_c_k = system.motion.T_c_w @ se3.inverse(system.map.pose_of(last))
        change = self.atlas.update()
        if change is None:
            return None
        system.fusion.join(system.map.whole)
        self._follow(last, T_c_k, change.growth(last))
        system.events[change.kind] = system.events.get(change.kind, 0) + 1
        return change

    def _follow(self, last: int, T_c_k: FloatArray, scale: float) -> None:
        """Transform the pose ``T_c_k`` ``(4, 4)`` at a keyframe, and the metric scale, with a map that was moved."""
        system = self.system
        system.motion.transform(se3.scaled(T_c_k, scale) @ system.map.pose_of(last), scale)
        system.compare_depths_again()
        system.fusion.revise(*system.log.poses())
        # Poses published before belong to the map before the change.
        system.published = replace(system.published, revision=system.published.revision + 1)
