"""A wall that is a mirror: a camera sees in it a second copy of the world, behind the wall."""

import numpy as np

from edgeslam_torch.synthetic.house.world import Quad, Texture, World

REFLECTION = "reflection"
"""Name of surfaces that are seen and not there."""
_ON_WALL_M = 0.03
"""What is nearer to the wall belongs to it: skirting boards."""


def mirrored(world: World) -> World:
    """The world with its outer wall at the high end of x taken as a mirror.

    The wall's surface gives way to a reflected copy of everything, so that pictures and depth show what a camera before
    a mirror sees. The copy's surfaces are named `REFLECTION`; the wall stays the world's bound.
    """
    wall = float(world.bounds_w[1, 0])
    kept = [world.quads[k] for k in np.flatnonzero(world.corners_w[:, :, 0].min(1) < wall - _ON_WALL_M)]
    behind = [_reflected(q, wall) for q in kept]
    return World([*kept, *behind], world.name, world.bounds_w, world.boxes, world.unseen)


def _reflected(quad: Quad, wall: float) -> Quad:
    """The other side of x = ``wall``; right becomes left, so that it is still seen from its painted side."""
    flip = np.array([-1.0, 1.0, 1.0])
    origin = (quad.origin_w + quad.u_w) * flip
    origin[0] += 2.0 * wall
    texture = Texture(lambda: quad.texture.level(0)[:, ::-1])
    return Quad(origin, -quad.u_w * flip, quad.v_w * flip, texture, REFLECTION, quad.two_sided)
