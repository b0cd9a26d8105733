"""Stamps of a topic's messages: of their headers, unless these are zero, frozen, backwards or of another clock."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

_OTHER_CLOCK_S = 5.0
"""Difference between header and receipt that no network explains."""
_EPOCH_S = 86400.0
_BACK_S = 1.0
"""Maximum step back of messages out of order; larger steps mean that the clock was set."""
_SLACK_S, _SLACK = 2.0, 4.0
"""A header's step is accepted up to this value and this multiple of the step of the receipt times."""


def header_s(message: Any) -> float | None:
    """Stamp of a message's header [s]; None if it has none.

    rosbags gives both versions of ROS the fields ``sec`` and ``nanosec``.
    """
    header = getattr(message, "header", None)
    return None if header is None else header.stamp.sec + 1e-9 * header.stamp.nanosec


@dataclass(frozen=True, slots=True)
class Offset:
    """How a topic's headers relate to the times of receipt."""

    value_s: float
    """Median of header minus receipt."""
    fault: str | None
    """Why the headers cannot be used; None if they can."""

    @property
    def other_epoch(self) -> bool:
        """Whether the headers count from another moment than Unix time."""
        return self.fault is None and abs(self.value_s) > _EPOCH_S


def measure(first: Sequence[tuple[float, float | None]]) -> Offset:
    """From receipt and header [s] of a topic's first messages."""
    headers = [header for _, header in first if header is not None]
    if not headers:
        return Offset(0.0, "has no header stamps")
    if not any(headers):
        return Offset(0.0, "header stamps are zero")
    if len(headers) > 2 and len(set(headers)) == 1:
        return Offset(0.0, "header stamps never change")
    steps = np.diff(headers)
    if len(steps) > 1 and (steps < 0).sum() > len(steps) / 2:
        return Offset(0.0, "header stamps run backwards")
    known = [(received, header) for received, header in first if header]
    return Offset(float(np.median([header - received for received, header in known])), None)


def disagree(a: Offset, b: Offset) -> bool:
    """Whether two topics' headers come from different clocks."""
    return abs(a.value_s - b.value_s) > _OTHER_CLOCK_S


class TopicClock:
    """Stamps of one topic's messages, in the order of their receipt."""

    def __init__(self, offset_s: float, use_header: bool) -> None:
        """``offset_s``: of the recording's clock, from receipt."""
        self._offset_s, self._use_header = offset_s, use_header
        self._last_s = self._last_received_s = math.nan
        self._shift_s = 0.0
        self.mended = 0
        """Messages whose header was off: their stamp continues by the time between receipts."""

    def stamp(self, received_s: float, header: float | None) -> float:
        """Stamp [s] of the next message."""
        if header is None or not self._use_header:
            return received_s + self._offset_s
        if math.isnan(self._last_s):
            near = abs(header - received_s - self._offset_s) <= _OTHER_CLOCK_S
            stamp, self.mended = (header, 0) if near else (received_s + self._offset_s, 1)
        else:
            stamp = self._following(received_s, header)
            if stamp <= self._last_s:
                return stamp
        self._last_s, self._last_received_s = stamp, received_s
        return stamp

    def _following(self, received_s: float, header: float) -> float:
        passed_s = max(0.0, received_s - self._last_received_s)
        for shift in (0.0, self._shift_s):
            step = header + shift - self._last_s
            if -_BACK_S < step <= _SLACK_S + _SLACK * passed_s:
                return header + shift
        self.mended += 1
        stamp = self._last_s + max(passed_s, 1e-6)
        self._shift_s = stamp - header
        return stamp
