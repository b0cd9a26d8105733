"""A Tello's answers: which text answers which command, and what is a refusal."""

import re

from edgeslam_torch.errors import EdgeSlamError


class TelloError(EdgeSlamError):
    """The drone does not answer, refuses, or is not allowed to execute a command."""


class NoAnswer(TelloError):
    """A command was not answered; the drone may have received it or not."""


REFUSALS = (
    "error",
    "unknown command",
    "out of range",
    "unactive",
    "not joystick",
    "motor stop",
    "no valid imu",
    "run timeout",
    "auto land",
)
"""Prefixes of refusals in SDK 1.3, SDK 2.0 and observed answers."""
_AGREEMENTS = ("ok", "forced stop")
_WORDS = ("sn?", "hardware?", "active?", "sdk?", "ssid?", "wifiversion?", "ap?")
"""Queries whose answer need not contain a number."""


def is_refusal(answer: str) -> bool:
    """Whether an answer is a refusal."""
    return answer.lower().startswith(REFUSALS)


def belongs_to(command: str, answer: str) -> bool:
    """Whether a datagram may answer a command.

    Answers do not identify their command: a late ``ok`` of the previous one, or noise, must not count.

    Example:
        >>> belongs_to("battery?", "87"), belongs_to("battery?", "ok"), belongs_to("land", "87")
        (True, False, False)
    """
    if not (answer.isascii() and answer.isprintable() and len(answer) < 200):
        return False
    if is_refusal(answer):
        return True
    if not command.endswith("?"):
        return answer.lower().startswith(_AGREEMENTS)
    if command in _WORDS:
        return re.match(r"[A-Za-z0-9]{2}", answer) is not None and answer.lower() not in _AGREEMENTS
    return re.match(r"-?\d|(pitch|agx|mid|roll):", answer) is not None
