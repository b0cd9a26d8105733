"""Seeded textured indoor worlds with exact depth, edges, poses and telemetry."""

from edgeslam_torch.synthetic.points import PointWorld, box_room

__all__ = ["PointWorld", "box_room"]
