"""What a Tello answers to a command: which text belongs to which command, and what is a refusal."""

import re

from edgeslam_torch.errors import EdgeSlamError


class TelloError(EdgeSlamError):
    """The drone does not answer, refuses, or may not do what was asked."""


class NoAnswer(TelloError):
    """A command was sent and nothing came back: it may have been heard or not."""


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
"""Beginnings of answers that mean "no", as SDK 1.3, 2.0 and the drones themselves word them."""
_AGREEMENTS = ("ok", "forced stop")
_WORDS = ("sn?", "hardware?", "active?", "sdk?", "ssid?", "wifiversion?", "ap?")
"""Questions whose answer need not hold a number."""


def is_refusal(answer: str) -> bool:
    """Whether the drone will not do it."""
    return answer.lower().startswith(REFUSALS)


def belongs_to(command: str, answer: str) -> bool:
    """Whether a datagram can be the answer to a command.

    Answers carry no number of what they answer: a late ``ok`` of the command before, or noise, must not pass for one.

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
