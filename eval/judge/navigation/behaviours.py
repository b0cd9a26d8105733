"""Behaviours: sequences of skills with success criteria."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.eval.judge.navigation.flown import Flown
from edgeslam_torch.navigation.openings.exit_tracker import Exit
from edgeslam_torch.navigation.skills.explore import Explore
from edgeslam_torch.navigation.skills.follow_corridor import FollowCorridor
from edgeslam_torch.navigation.skills.go_to import GoTo
from edgeslam_torch.navigation.skills.return_home import ReturnHome
from edgeslam_torch.navigation.skills.skill import Skill
from edgeslam_torch.synthetic.sites.site import Site, TrueExit
from edgeslam_torch.types import FloatArray

REACHED_M = 0.35
"""Distance to the true goal that counts as reached when the planner reports it."""
HOME_M = 0.3
"""Distance to the true take-off that counts as home."""
EXPLORED_S, FOLLOWED_S = 300.0, 100.0
"""Time to explore a building of six rooms, and to follow a corridor."""
_END_M = 1.6
"""Distance to a corridor's true end that counts as reached; the drone stops 0.6 m before a wall."""
_SAME_EXIT_M, _SAME_EXIT_COS = 0.5, np.cos(np.radians(35.0))


@dataclass(frozen=True, slots=True)
class Moment:
    """State at the start of a skill."""

    site: Site
    clock_s: float
    scale: float
    """True metres per estimated metre."""
    track_w: FloatArray
    """``(N, 2)`` path flown by the estimated pose."""


@dataclass(frozen=True, slots=True)
class Behaviour:
    """Skills and their success criterion."""

    steps: tuple[Callable[[Moment], Skill], ...]
    reached: Callable[[Flown, Site], bool]
    """Whether a flight that completed its last skill without contact reached its goal."""
    limit_s: float = 120.0


def _goal(moment: Moment) -> Skill:
    return GoTo(moment.site.goal_w / moment.scale)


def _home(moment: Moment) -> Skill:
    return ReturnHome(moment.track_w)


def _at_home(flown: Flown, site: Site) -> bool:
    return flown.home_m < HOME_M


def _at_an_end(flown: Flown, site: Site) -> bool:
    here = np.array(flown.track_w[-1][:2])
    return bool(min(np.linalg.norm(here - end) for end in corridor_ends(site)) < _END_M)


def is_corridor(world: str) -> bool:
    """Whether a named site is a corridor."""
    return world == "blank_walls" or world.endswith("corridor")


def corridor_ends(site: Site) -> list[FloatArray]:
    """Points ``(2,)`` at which a corridor followed from the start may end: a door, or the end of an arm.

    Raises:
        ValueError: If the site is no corridor.
    """
    if not is_corridor(site.name):
        raise ValueError(f"{site.name} is not a corridor")
    goal = site.goal_w[:2]
    if site.exits:
        return [e.centre_w[:2] for e in site.exits]
    return [goal, goal * [1.0, -1.0]] if site.name == "t_corridor" else [goal]


BEHAVIOURS = {
    "goto": Behaviour((_goal,), lambda flown, site: flown.distance_m < REACHED_M),
    "home": Behaviour((_goal, _home), _at_home, 240.0),
    "corridor": Behaviour((lambda moment: FollowCorridor(until_s=moment.clock_s + FOLLOWED_S),), _at_an_end, 160.0),
    "exits": Behaviour((lambda moment: Explore(until_s=moment.clock_s + EXPLORED_S), _home), _at_home, 540.0),
}
"""By name; ``exits`` explores for `EXPLORED_S` and returns home, and the exits found are scored, too."""


def right_exits(found: Sequence[Exit], site: Site) -> int:
    """Number of the site's exits among those found: within half a metre and in the same wall.

    Example:
        >>> from edgeslam_torch.synthetic.sites.build import named_site
        >>> right_exits([], named_site("corridor", 0))
        0
    """

    def same(exit_: Exit, true: TrueExit) -> bool:
        near = float(np.linalg.norm(exit_.centre_w[:2] - true.centre_w[:2])) < _SAME_EXIT_M
        return near and abs(float(exit_.normal_w @ true.normal_w)) > _SAME_EXIT_COS

    return sum(any(same(exit_, true) for exit_ in found) for true in site.exits)
