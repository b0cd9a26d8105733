"""Replay of a recorded flight's states through the planner, in this version or with other limits.

States stay as recorded, so single decisions are compared, not the flight that would follow.
"""

import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from edgeslam_torch.errors import SourceError
from edgeslam_torch.flying.flight_controller import FlightController
from edgeslam_torch.navigation.drone_state import Contact, DroneState, VelocityCommand
from edgeslam_torch.navigation.flight_record import PLAN, Decision, NewSkill, read_plan
from edgeslam_torch.navigation.limits import NavLimits

_SAME = 0.02
"""Commands that differ by less [m/s, rad/s] are equal; a Tello's sticks have a resolution of 0.01."""


@dataclass(frozen=True, slots=True)
class Step:
    """One decision, recorded and replayed."""

    state: DroneState
    before: Decision | None
    """None if the recorded planner did not answer: it hung or failed, or the program ended."""
    now: Decision
    planning_s: float
    """Duration of the replayed decision."""

    @property
    def same(self) -> bool:
        """Whether both decisions are equal."""
        if self.before is None or self.before.phase != self.now.phase:
            return False
        return bool(np.abs(_sticks(self.before.command) - _sticks(self.now.command)).max() <= _SAME)


@dataclass(frozen=True, slots=True)
class Replay:
    """Decisions of a flight, recorded and replayed."""

    limits: NavLimits
    """Limits of the replay."""
    steps: tuple[Step, ...]
    skills: tuple[str, ...]
    """Names, in order."""

    @property
    def differing(self) -> list[Step]:
        """Decisions that differ from the recorded ones."""
        return [step for step in self.steps if not step.same]


def replay(folder: Path, **limits: float) -> Replay:
    """Run a new planner on the recorded states.

    Args:
        folder: Folder of `edgeslam fly --record`.
        **limits: Fields of `NavLimits` that differ from the recorded flight's.

    Raises:
        SourceError: If the record is missing, damaged, or holds no state.
        ValueError: If the limits are inconsistent.
    """
    path = folder / PLAN
    entries = read_plan(path)
    recorded = next(entries, None)
    if not isinstance(recorded, NavLimits):
        raise SourceError(f"{path}: does not begin with the flight's limits")
    used = replace(recorded, **limits)
    flight_controller, seen, steps, skills = FlightController(used), None, [], []
    for entry in entries:
        if isinstance(entry, Decision):
            if seen is not None:
                steps.append(_decided(flight_controller, seen, entry))
            seen = None
            continue
        if seen is not None:  # no answer was recorded
            steps.append(_decided(flight_controller, seen, None))
            seen = None
        if isinstance(entry, NewSkill):
            flight_controller.begin(entry.skill)
            skills.append(type(entry.skill).__name__)
        elif isinstance(entry, Contact):
            flight_controller.feel(entry)
        elif isinstance(entry, DroneState):
            seen = entry
    if seen is not None:
        steps.append(_decided(flight_controller, seen, None))
    if not steps:
        raise SourceError(f"{path}: the record holds no state")
    return Replay(used, tuple(steps), tuple(skills))


def summary(found: Replay) -> list[str]:
    """Summary of a replay, one string per line."""
    steps, differing = found.steps, found.differing
    began = steps[0].state.stamp_s
    took_ms = 1e3 * np.array([step.planning_s for step in steps])
    lines = [
        f"{len(steps)} decisions in {steps[-1].state.stamp_s - began:.1f} s, "
        f"skills: {', '.join(found.skills) or 'none'}",
        f"the same: {len(steps) - len(differing)} of {len(steps)}",
    ]
    for step in differing[:1]:
        lines.append(f"first difference after {step.state.stamp_s - began:.2f} s, at {_place(step.state)}:")
        lines.append(f"  then: {'no answer' if step.before is None else _words(step.before)}")
        lines.append(f"  now:  {_words(step.now)}")
    lines.append(f"planning now: median {np.median(took_ms):.1f} ms, 95 % within {np.quantile(took_ms, 0.95):.1f} ms")
    return lines


def _decided(flight_controller: FlightController, state: DroneState, before: Decision | None) -> Step:
    began = time.perf_counter()
    now = flight_controller.plan(state)
    return Step(state, before, now, time.perf_counter() - began)


def _sticks(command: VelocityCommand) -> np.ndarray:
    return np.array([command.forward_m_s, command.left_m_s, command.up_m_s, command.turn_left_rad_s])


def _place(state: DroneState) -> str:
    return "({:.2f}, {:.2f}, {:.2f}) m".format(*state.p_w)


def _words(decision: Decision) -> str:
    forward, left, up, turn = _sticks(decision.command)
    moves = f"forward {forward:.2f}, left {left:.2f}, up {up:.2f} m/s, turn left {np.degrees(turn):.0f} deg/s"
    return f"{decision.phase}; {moves}; {decision.command.why}"
