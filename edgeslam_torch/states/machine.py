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
from collections import Counter
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


_FOUND = {Event.POINTS: State.TRACKING, Event.EDGES: State.EDGES_ONLY, Event.NOTHING: State.LOST}

TRANSITIONS: dict[State, dict[Event, State]] = {
    State.STARTING: {
        Event.WAITING: State.STARTING,
        Event.BEGUN: State.STARTING,  # the first keyframe left the view: next attempt
        Event.NO_TEXTURE: State.LOST,
        Event.MAP_READY: State.TRACKING,
        Event.RETURNED: State.TRACKING,
    },
    State.TRACKING: _FOUND,
    State.EDGES_ONLY: _FOUND,
    State.LOST: {Event.POINTS: State.TRACKING, Event.NOTHING: State.LOST, Event.BEGUN: State.STARTING},
}
"""Transitions. The states cause no other events; an event leads to the same state wherever it is listed."""

LEADS_TO: dict[Event, State] = {event: state for row in TRANSITIONS.values() for event, state in row.items()}
"""State after each event, also after one that its state does not list."""


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
        self.unexpected: Counter[str] = Counter()
        """Events that their state does not list: programming errors, counted by state and event."""

    def apply(self, event: Event, stamp_s: float) -> None:
        """Apply an event. One that the current state does not list is counted and applied all the same."""
        if event not in TRANSITIONS[self.state]:
            self.unexpected[f"{event} while {self.state}"] += 1
        self.state = LEADS_TO[event]
        if self.state is not State.LOST:
            self.lost_frames, self.lost_since_s = 0, math.inf
            return
        self.lost_frames += 1
        if event is Event.NO_TEXTURE:
            self.lost_since_s = -math.inf
        elif self.lost_frames == 1:
            self.lost_since_s = stamp_s

    def warning(self) -> str | None:
        """Unlisted transitions that occurred; None if there were none."""
        if not self.unexpected:
            return None
        cases = ", ".join(f"{what} ({count} times)" for what, count in self.unexpected.items())
        return f"transitions that the table of states does not list: {cases}; please report this"
