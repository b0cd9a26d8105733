"""A world with a task: where a drone starts, where it should go, and which openings are exits."""

from dataclasses import dataclass

import numpy as np

from edgeslam_torch.synthetic.house.world import World
from edgeslam_torch.synthetic.sites.people import Walker
from edgeslam_torch.types import FloatArray


@dataclass(frozen=True, slots=True)
class TrueExit:
    """An opening in a wall with free space on both sides."""

    centre_w: FloatArray
    """``(3,)`` middle of the opening, at half its height [m]."""
    normal_w: FloatArray
    """``(3,)`` level unit vector through the opening, away from the start."""
    width_m: float
    height_m: float


@dataclass(frozen=True, slots=True)
class Site:
    """A world with its ground truth. The floor is at z = 0."""

    name: str
    seed: int
    world: World
    T_site_w: FloatArray
    """``(4, 4)`` the drone's own world (origin on the floor below it, x forward) in the site's axes."""
    goal_w: FloatArray
    """``(3,)`` where to go, in the drone's own world [m]."""
    exits: tuple[TrueExit, ...]
    """In the drone's own world."""
    walkers: tuple[Walker, ...] = ()
    """People, who are not in `world`."""

    def clearance(self, p_w: FloatArray, clock_s: float | None = None) -> FloatArray:
        """Distance [m] from points ``(N, 3)`` of the drone's own world to the nearest solid, or person at a time."""
        p = self.in_site(p_w)
        people = [walker.distance(p, clock_s) for walker in self.walkers] if clock_s is not None else []
        return np.min([self.world.distance_to_solid(p), *people], axis=0)

    def painted(self, clock_s: float) -> World:
        """What a camera sees at a time."""
        people = [quad for walker in self.walkers for quad in walker.painted(clock_s)]
        still = self.world
        return World([*still.quads, *people], still.name, still.bounds_w, still.boxes) if people else still

    def in_site(self, p_w: FloatArray) -> FloatArray:
        """Points ``(..., 3)`` of the drone's own world in the site's axes."""
        return np.asarray(p_w) @ self.T_site_w[:3, :3].T + self.T_site_w[:3, 3]
