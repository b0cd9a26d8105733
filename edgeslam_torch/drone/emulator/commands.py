"""The SDK's command language: effect, answer and time of answer of each command."""

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from edgeslam_torch.drone.emulator.drone import DroneModel
from edgeslam_torch.drone.sdk_state import GRAVITY_M_S2

_DIRECTIONS = {
    "forward": (1.0, 0.0, 0.0),
    "back": (-1.0, 0.0, 0.0),
    "left": (0.0, 1.0, 0.0),
    "right": (0.0, -1.0, 0.0),
    "up": (0.0, 0.0, 1.0),
    "down": (0.0, 0.0, -1.0),
}
_SETTINGS = ("wifi", "ap", "setfps", "setbitrate", "setresolution", "downvision", "mdirection", "port")
_PLAIN = ("mon", "moff", "motoron", "motoroff", "keepalive", "reboot")


class Answer(StrEnum):
    """Time at which a command is answered."""

    NOW = "now"
    WHEN_DONE = "when done"
    NEVER = "never"


@dataclass(frozen=True, slots=True)
class Reply:
    """Text and time of an answer."""

    text: str
    when: Answer = Answer.NOW


class Interpreter:
    """The part of SDK 2.0 for a drone without expansion board."""

    def __init__(self, drone: DroneModel) -> None:
        self.drone = drone
        self.sdk_mode = False
        self.stream = False
        self.speed_cm_s = 50

    def run(self, text: str) -> Reply:
        """Carry out one command line."""
        words = text.strip().split()
        if not words:
            return Reply("error")
        name = words[0].lower()
        if name == "command":
            self.sdk_mode = True
            return Reply("ok")
        if not self.sdk_mode:
            return Reply("", Answer.NEVER)  # a real drone is silent until it receives "command"
        if name.endswith("?"):
            return self._query(name)
        numbers = _numbers(words[1:])
        if name == "rc":
            return self._rc(numbers)
        if name in ("takeoff", "throwfly"):
            return Reply("ok", Answer.WHEN_DONE) if self.drone.take_off() else Reply("error")
        if name == "land":
            if not self.drone.flying:
                return Reply("error")
            self.drone.land()
            return Reply("ok", Answer.WHEN_DONE)
        if name == "emergency":
            self.drone.cut()
            return Reply("ok")
        if name in ("streamon", "streamoff"):
            self.stream = name == "streamon"
            return Reply("ok")
        if name == "speed":
            return self._set_speed(numbers)
        if name in _SETTINGS or name in _PLAIN:
            return Reply("ok" if len(words) > 1 or name in _PLAIN else "error")
        return self._movement(name, words[1:], numbers)

    def _movement(self, name: str, words: list[str], numbers: list[float] | None) -> Reply:
        drone = self.drone
        if name not in _DIRECTIONS and name not in ("cw", "ccw", "go", "curve", "flip", "stop"):
            return Reply(f"unknown command: {name}")
        if not drone.flying:
            return Reply("error Not joystick")
        if name == "stop":
            drone.stop()
            return Reply("ok")
        if name == "flip":
            return Reply("ok" if words and words[0] in "lrfb" else "error")
        if numbers is None:
            return Reply("error")
        if name in _DIRECTIONS and len(numbers) == 1:
            if not 20 <= numbers[0] <= 500:
                return Reply("out of range")
            drone.move(0.01 * numbers[0] * np.array(_DIRECTIONS[name]), 0.01 * self.speed_cm_s)
            return Reply("ok", Answer.WHEN_DONE)
        if name in ("cw", "ccw") and len(numbers) == 1:
            if not 1 <= numbers[0] <= 360:
                return Reply("out of range")
            drone.turn(math.radians(numbers[0]) * (1.0 if name == "ccw" else -1.0))
            return Reply("ok", Answer.WHEN_DONE)
        if name == "go" and len(numbers) == 4:
            return self._go(numbers[:3], numbers[3])
        if name == "curve" and len(numbers) == 7:
            return self._go(numbers[3:6], numbers[6])
        return Reply("error")

    def _go(self, cm: list[float], speed: float) -> Reply:
        far = max(abs(x) for x in cm)
        if not (20 <= far <= 500 and 10 <= speed <= 100):
            return Reply("out of range")
        self.drone.move(0.01 * np.array(cm), 0.01 * speed)  # SDK: x forward, y left, z up
        return Reply("ok", Answer.WHEN_DONE)

    def _rc(self, numbers: list[float] | None) -> Reply:
        if numbers is not None and len(numbers) == 4 and max(abs(n) for n in numbers) <= 100:
            right, forward, up, clockwise = (0.01 * n for n in numbers)
            self.drone.rc = (right, forward, up, clockwise)
        return Reply("", Answer.NEVER)

    def _set_speed(self, numbers: list[float] | None) -> Reply:
        if numbers is None or len(numbers) != 1 or not 10 <= numbers[0] <= 100:
            return Reply("error")
        self.speed_cm_s = int(numbers[0])
        return Reply("ok")

    def _query(self, name: str) -> Reply:
        drone = self.drone
        rpy = np.degrees(drone.rpy())
        force = 1e3 / GRAVITY_M_S2 * drone.specific_force()
        answers = {
            "battery?": f"{math.ceil(100 * drone.battery)}",
            "speed?": f"{self.speed_cm_s:.1f}",
            "time?": f"{int(drone.motor_s)}s",
            "height?": f"{round(10 * drone.p_w[2])}dm",
            "temp?": "58~60C",
            "attitude?": f"pitch:{round(-rpy[1])};roll:{round(rpy[0])};yaw:{round(-rpy[2])};",
            "baro?": f"{100 + drone.p_w[2]:.6f}",
            "acceleration?": f"agx:{force[0]:.2f};agy:{-force[1]:.2f};agz:{-force[2]:.2f};",
            "tof?": f"{round(1000 * drone.p_w[2])}mm",
            "wifi?": "90",
            "sdk?": "20",
            "sn?": "0TQEMULATED0001",
            "hardware?": "TELLO",
            "active?": "active",
        }
        if name not in answers:
            return Reply(f"unknown command: {name}")
        return Reply(answers[name] + "\r\n")


def _numbers(words: list[str]) -> list[float] | None:
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        return None
    return numbers if all(math.isfinite(n) for n in numbers) else None
