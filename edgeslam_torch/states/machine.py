"""The states of the system and all transitions.

::

       two views, map from depth, earlier submap           edges alone
    STARTING ---------------------------> TRACKING <----------------------> EDGES_ONLY
      ^   ^ \\                              |    ^           points             |
      |   |  \\ too little texture          |    |                              |
      |   +-- first view lost               | no pose                           | no pose
      |        \\                           v    | relocalised                  |
      +---------+-----------------------> LOST ---+ <---------------------------+
         lost for too long
"""

import math
from enum import StrEnum


class State(StrEnum):
    """What the current pose is based on."""

    STARTING = "starting"
    """Predicted depths of a submap's first keyframe; nothing is triangulated yet."""
    TRACKING = "tracking"
    """Keypoints of the map, with or without edges."""
    EDGES_ONLY = "edges only"
    """Edges of the map; too few keypoints agree."""
    LOST = "lost"
    """Motion prediction."""


class Event(StrEnum):
    """Outcome of a frame."""

    BEGUN = "begun"
    """A submap was started with predicted depths."""
    NO_TEXTURE = "too little texture to begin"
    WAITING = "waiting for parallax"
    MAP_READY = "map ready"
    """A map exists, from two views or from the depth network if the view changed before there was parallax."""
    RETURNED = "found in an earlier submap"
    POINTS = "found by points"
    EDGES = "found by edges alone"
    NOTHING = "not found"


NEXT: dict[Event, State] = {
    Event.BEGUN: State.STARTING,  # also when the first keyframe has left the view: next attempt
    Event.WAITING: State.STARTING,
    Event.NO_TEXTURE: State.LOST,
    Event.MAP_READY: State.TRACKING,
    Event.RETURNED: State.TRACKING,
    Event.POINTS: State.TRACKING,
    Event.EDGES: State.EDGES_ONLY,
    Event.NOTHING: State.LOST,
}
"""State after each event, from whichever state."""


class Machine:
    """The current state and the duration of a loss.

    Example:
        >>> machine = Machine()
        >>> for stamp_s, event in enumerate([Event.BEGUN, Event.MAP_READY, Event.NOTHING, Event.NOTHING]):
        ...     machine.apply(event, stamp_s)
        >>> machine.state, machine.lost_frames, machine.lost_since_s
        (<State.LOST: 'lost'>, 2, 2)
    """

    def __init__(self) -> None:
        self.state = State.STARTING
        self.lost_frames = 0
        """Frames in a row without a pose."""
        self.lost_since_s = math.inf
        """Stamp of the first of them; infinite while not lost, minus infinity without a map to relocalise in."""

    def apply(self, event: Event, stamp_s: float) -> None:
        """Apply the event of a frame."""
        self.state = NEXT[event]
        if self.state is not State.LOST:
            self.lost_frames, self.lost_since_s = 0, math.inf
            return
        self.lost_frames += 1
        if event is Event.NO_TEXTURE:
            self.lost_since_s = -math.inf
        elif self.lost_frames == 1:
            self.lost_since_s = stamp_s
