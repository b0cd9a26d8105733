"""The states of the system and every way from one to another.

::

       two views, map from depth, earlier piece            edges alone
    STARTING ---------------------------> TRACKING <----------------------> EDGES_ONLY
      ^   ^ \\                              |    ^           points             |
      |   |  \\ too little texture          |    |                              |
      |   +-- guess out of sight            | no pose                           | no pose
      |        \\                           v    | found again                  |
      +---------+-----------------------> LOST ---+ <---------------------------+
         lost for too long
"""

import math
from enum import StrEnum


class State(StrEnum):
    """What carries the present pose."""

    STARTING = "starting"
    """Depths guessed at the first keyframe of a piece of map; nothing was triangulated yet."""
    TRACKING = "tracking"
    """Keypoints of the map, with or without edges beside them."""
    EDGES_ONLY = "edges only"
    """Edges of the map; too few keypoints agree."""
    LOST = "lost"
    """A prediction."""


class Event(StrEnum):
    """What a frame brought."""

    BEGUN = "begun"
    """A piece of map was begun with guessed depths."""
    NO_TEXTURE = "too little texture to begin"
    WAITING = "waiting for parallax"
    MAP_STANDS = "map stands"
    """From two views, or from the depth network where the view changed before parallax came."""
    RETURNED = "found in an earlier piece of map"
    POINTS = "found by points"
    EDGES = "found by edges alone"
    NOTHING = "not found"


_FOUND = {Event.POINTS: State.TRACKING, Event.EDGES: State.EDGES_ONLY, Event.NOTHING: State.LOST}

TRANSITIONS: dict[State, dict[Event, State]] = {
    State.STARTING: {
        Event.WAITING: State.STARTING,
        Event.BEGUN: State.STARTING,  # the guess went out of sight: the next attempt
        Event.NO_TEXTURE: State.LOST,
        Event.MAP_STANDS: State.TRACKING,
        Event.RETURNED: State.TRACKING,
    },
    State.TRACKING: _FOUND,
    State.EDGES_ONLY: _FOUND,
    State.LOST: {Event.POINTS: State.TRACKING, Event.NOTHING: State.LOST, Event.BEGUN: State.STARTING},
}
"""Where each event leads; an event that is not listed cannot happen."""


class Machine:
    """The present state and how long the pose has been a prediction.

    Example:
        >>> machine = Machine()
        >>> for stamp_s, event in enumerate([Event.BEGUN, Event.MAP_STANDS, Event.NOTHING, Event.NOTHING]):
        ...     machine.meet(event, stamp_s)
        >>> machine.state, machine.lost_frames, machine.lost_since_s
        (<State.LOST: 'lost'>, 2, 2)
    """

    def __init__(self) -> None:
        self.state = State.STARTING
        self.lost_frames = 0
        """Frames in a row without a pose."""
        self.lost_since_s = math.inf
        """Stamp of the first of them; infinite while not lost, minus infinity where there is nothing to find again."""

    def meet(self, event: Event, stamp_s: float) -> None:
        """Go where an event leads.

        Raises:
            KeyError: If the event cannot happen in the present state.
        """
        self.state = TRANSITIONS[self.state][event]
        if self.state is not State.LOST:
            self.lost_frames, self.lost_since_s = 0, math.inf
            return
        self.lost_frames += 1
        if event is Event.NO_TEXTURE:
            self.lost_since_s = -math.inf
        elif self.lost_frames == 1:
            self.lost_since_s = stamp_s
