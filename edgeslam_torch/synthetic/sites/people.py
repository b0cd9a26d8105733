"""People who walk to and fro, painted and solid, and blind: they do not make way."""

from dataclasses import dataclass, replace

import numpy as np

from edgeslam_torch.synthetic.house.pieces import build
from edgeslam_torch.synthetic.house.scene import Place, Scene
from edgeslam_torch.synthetic.house.world import Box, Quad, to_boxes
from edgeslam_torch.types import FloatArray

Rng = np.random.Generator


@dataclass(frozen=True, slots=True, eq=False)
class Walker:
    """One person between two places of the floor. Their own axes: x ahead, origin between the feet."""

    quads: tuple[Quad, ...]
    boxes: tuple[Box, ...]
    ends_w: FloatArray
    """``(2, 2)`` where they turn round, in the site's axes [m]."""
    speed_m_s: float
    first_s: float
    """How long ago they left the first end when the clock is at zero."""

    def at(self, clock_s: float) -> tuple[FloatArray, float]:
        """Where they are ``(2,)`` [m] and their heading [rad]."""
        step = self.ends_w[1] - self.ends_w[0]
        length = float(np.linalg.norm(step))
        way = (self.speed_m_s * (clock_s + self.first_s)) % (2.0 * length)
        ahead = float(np.arctan2(step[1], step[0]))
        if way <= length:
            return self.ends_w[0] + step * (way / length), ahead
        return self.ends_w[1] - step * (way / length - 1.0), ahead + np.pi

    def painted(self, clock_s: float) -> list[Quad]:
        """Their surfaces in the site's axes."""
        (x, y), yaw = self.at(clock_s)
        place = Place(float(x), float(y), yaw)
        return [
            replace(q, origin_w=place.point(q.origin_w), u_w=place.direction(q.u_w), v_w=place.direction(q.v_w))
            for q in self.quads
        ]

    def distance(self, p_w: FloatArray, clock_s: float) -> FloatArray:
        """Distance [m] of points ``(N, 3)`` of the site to them; 0 inside."""
        (x, y), yaw = self.at(clock_s)
        c, s = np.cos(yaw), np.sin(yaw)
        local = np.array(p_w, dtype=np.float64)
        dx, dy = local[:, 0] - x, local[:, 1] - y
        local[:, 0], local[:, 1] = c * dx + s * dy, c * dy - s * dx
        return to_boxes(self.boxes)(local)


def walker(rng: Rng, ends_w: FloatArray, speed_m_s: float) -> Walker:
    """A grown person of random size and clothes, somewhere on their way between two ends ``(2, 2)`` [m].

    Raises:
        ValueError: If the ends are the same place, or they do not walk.
    """
    length = float(np.linalg.norm(ends_w[1] - ends_w[0]))
    if length < 0.1 or speed_m_s <= 0:
        raise ValueError(f"a walker needs two places and a speed, got {ends_w.tolist()} at {speed_m_s} m/s")
    scene = Scene(np.array([-2.0, -2.0, 0.0]), np.array([2.0, 2.0, 3.0]), lamps_w=[np.array([0.5, 0.8, 2.9])])
    build(scene, Place(0.0, 0.0, 0.0), rng, "person")
    world = scene.world("person")
    return Walker(
        world.quads, world.boxes, np.asarray(ends_w), speed_m_s, float(rng.uniform(0, 2 * length / speed_m_s))
    )
