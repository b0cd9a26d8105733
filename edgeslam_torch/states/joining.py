"""Joining of pieces between two frames, when new keyframes connect them; the current pose is transformed along."""

from dataclasses import replace

from edgeslam_torch.atlas.atlas import Atlas, Join
from edgeslam_torch.fusion.published import Published
from edgeslam_torch.geometry import se3, sim3
from edgeslam_torch.states.system import System


class Joining:
    """Queries the atlas while the map is not in use elsewhere."""

    def __init__(self, system: System, atlas: Atlas) -> None:
        self.system = system
        self.atlas = atlas
        self._piece: int | None = None
        """That the camera was in when the last frame was done."""

    def update(self) -> str:
        """Join pieces that the newest keyframes connect; returns the joins in words, empty without any."""
        if self.system.mapping.busy:
            return ""
        return "; ".join(join.in_words() for join in iter(self._once, None))

    def enter(self, piece: int) -> None:
        """Take over the metres of the camera's piece of map where an earlier flight has left them."""
        system = self.system
        if piece == self._piece:
            return
        self._piece = piece
        known = self.atlas.known_scale.get(piece)
        system.fusion.remember(known)
        if known is not None and (system.published.scale != known.value or system.published.offset.any()):
            system.published = Published(known.value, revision=system.published.revision + 1)

    def finish(self) -> None:
        """Query every keyframe again, since the pieces have grown."""
        self.atlas.ask_all_again()
        self.update()

    def _once(self) -> Join | None:
        system = self.system
        if self.atlas.is_up_to_date or not system.log.records:
            return None
        last = system.log.records[-1].keyframe_id
        piece, T_k_w = system.map.piece_of(last), system.map.pose_of(last)
        join = self.atlas.update()
        if join is None:
            return None
        T_c_k = system.motion.T_c_w @ se3.inverse(T_k_w)
        scale = sim3.scale_of(join.S) if join.moved == piece else 1.0
        T_c_k[:3, 3] *= scale
        system.motion.carry(T_c_k @ system.map.pose_of(last), scale)
        system.compare_depths_again()
        system.fusion.revise(*system.log.poses())
        # Poses published before belong to a piece that has moved since.
        system.published = replace(system.published, revision=system.published.revision + 1)
        system.events["joined"] = system.events.get("joined", 0) + 1
        return join
