"""Telemetry of a bag: odometry, velocities, attitude, range and battery as one series of samples."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from edgeslam_torch.drone.sdk_state import FIELDS, parse_state, sample_from_sdk
from edgeslam_torch.geometry.rotations import matrix_from_rpy
from edgeslam_torch.readers.bags.bag import Bag, Raw
from edgeslam_torch.readers.bags.clock import TopicClock, header_s
from edgeslam_torch.readers.bags.odometry import Motion, motion_of_odometry
from edgeslam_torch.types import FloatArray, TelemetrySample

_EVERY_S = 0.045
"""Minimum interval between samples; a Tello sends 10 Hz, and a higher rate has no benefit."""
_HOLD_S = 0.25
"""Maximum age of another topic's last message."""
_WORLD_FRAMES = ("map", "odom", "world", "earth", "local_origin", "enu")
_NAMES = {"odom": "Odometry", "velocity": "TwistStamped", "imu": "Imu", "tello": "FlightData"}

Row = tuple[float, ...]


def read_bag_telemetry(
    bag: Bag, topics: Mapping[str, str], asked: frozenset[str], clocks: Mapping[str, TopicClock]
) -> tuple[list[TelemetrySample], list[str]]:
    """All telemetry of a recording in time order, and remarks.

    Args:
        bag: The recording.
        topics: Role to topic.
        asked: Roles that the user named; they take precedence.
        clocks: Topic to its clock.
    """
    roles = {name: role for role, name in topics.items()}
    series: dict[str, list[Row]] = {role: [] for role in topics}
    frames: dict[str, tuple[str, str]] = {}
    for raw in _thinned(bag, list(roles)):
        role = roles[raw.topic]
        message = bag.decode(raw)
        stamp = clocks[raw.topic].stamp(raw.received_s, header_s(message))
        if series[role] and stamp <= series[role][-1][0]:
            continue
        frames.setdefault(role, _frames(message))
        series[role].append((stamp, *_ROWS[role](message)))
    tables: dict[str, FloatArray] = {role: np.array(rows, dtype=np.float64) for role, rows in series.items() if rows}
    return _merged(tables, topics, asked, frames)


def _thinned(bag: Bag, names: Sequence[str]) -> Iterator[Raw]:
    """At most one message a topic in `_EVERY_S`, by receipt; dropped ones are not decoded."""
    last: dict[str, float] = {}
    for raw in bag.messages(names):
        if not 0.0 <= raw.received_s - last.get(raw.topic, -math.inf) < _EVERY_S:
            last[raw.topic] = raw.received_s
            yield raw


def _frames(message: Any) -> tuple[str, str]:
    """Frame of the header and of the child."""
    header = getattr(message, "header", None)
    parent = str(header.frame_id) if header is not None else ""
    return parent.strip("/"), str(getattr(message, "child_frame_id", "")).strip("/")


def _odometry_row(message: Any) -> Row:
    p, q, v = message.pose.pose.position, message.pose.pose.orientation, message.twist.twist.linear
    return p.x, p.y, p.z, q.x, q.y, q.z, q.w, v.x, v.y, v.z


def _velocity_row(message: Any) -> Row:
    twist = message.twist.twist if hasattr(message.twist, "twist") else message.twist
    return twist.linear.x, twist.linear.y, twist.linear.z


def _imu_row(message: Any) -> Row:
    q, a = message.orientation, message.linear_acceleration
    known = message.orientation_covariance[0] >= 0  # -1: the sensor does not measure it
    turned = (q.x, q.y, q.z, q.w) if known else (math.nan,) * 4
    return *turned, a.x, a.y, a.z


def _range_row(message: Any) -> Row:
    inside = message.min_range <= message.range <= max(message.max_range, message.min_range)
    return (float(message.range) if inside and math.isfinite(message.range) else math.nan,)


def _battery_row(message: Any) -> Row:
    charge = float(message.percentage)
    charge = charge / 100.0 if charge > 1.0 else charge  # ROS: 0 to 1; some drivers: percent
    return (charge if 0.0 <= charge <= 1.0 else math.nan,)


def _tello_row(message: Any) -> Row:
    text = str(getattr(message, "raw", ""))
    fields = parse_state(text) if text else {}
    return tuple(_number(fields.get(name, getattr(message, name, math.nan))) for name in FIELDS)


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float | np.number) else math.nan


_ROWS = {
    "odom": _odometry_row,
    "velocity": _velocity_row,
    "imu": _imu_row,
    "range": _range_row,
    "battery": _battery_row,
    "tello": _tello_row,
}


def _merged(
    tables: dict[str, FloatArray],
    topics: Mapping[str, str],
    asked: frozenset[str],
    frames: Mapping[str, tuple[str, str]],
) -> tuple[list[TelemetrySample], list[str]]:
    said: list[str] = []
    if "imu" in tables and _never_turns(tables["imu"][:, 1:5]):
        said.append(f"{topics['imu']}: holds no attitude")
        del tables["imu"]
    order = [role for role in ("tello", "odom", "velocity") if role in tables]
    order.sort(key=lambda role: role not in asked)
    for role in order:
        if role == "tello":
            samples = [sample_from_sdk(row[0], dict(zip(FIELDS, row[1:], strict=True))) for row in tables["tello"]]
            return samples, [*said, _used(role, topics)]
        attitude = _attitude(tables)
        if role == "odom":
            motion, remark = motion_of_odometry(tables["odom"], *frames["odom"])
        else:
            motion, remark = _motion_of_twist(tables["velocity"], frames["velocity"][0], attitude)
        if remark:
            said.append(f"{topics[role]}: {remark}")
        if motion is not None:
            return _samples(motion, tables), [*said, _used(role, topics)]
    attitude = _attitude(tables)
    if attitude is not None:
        none = np.full((len(attitude[0]), 3), np.nan)
        said.append("no topic holds velocities, which the scale from telemetry needs")
        return _samples(Motion(attitude[0], none, attitude[1]), tables), said
    if tables:
        said.append("no velocity and no attitude in its telemetry, so the run goes without")
    return [], said


def _used(role: str, topics: Mapping[str, str]) -> str:
    return f"velocity and attitude are taken from {topics[role]} ({_NAMES[role]}); --topic changes that"


def _never_turns(quaternions: FloatArray) -> bool:
    """Whether an attitude is missing, or is a constant that the driver fills in."""
    known = quaternions[np.isfinite(quaternions).all(axis=1) & (np.abs(quaternions).sum(axis=1) > 0)]
    return len(known) == 0 or (len(known) > 10 and bool((known == known[0]).all()))


def _attitude(tables: Mapping[str, FloatArray]) -> tuple[FloatArray, FloatArray] | None:
    """Stamps ``(N,)`` and roll, pitch, yaw ``(N, 3)`` of the Imu, else of the odometry."""
    from scipy.spatial.transform import Rotation

    for role, first in (("imu", 1), ("odom", 4)):
        if role in tables:
            quaternions = tables[role][:, first : first + 4]
            unit = np.abs(np.linalg.norm(quaternions, axis=1) - 1.0) < 0.01
            if unit.any():
                return tables[role][unit, 0], Rotation.from_quat(quaternions[unit]).as_euler("ZYX")[:, ::-1]
    return None


def _motion_of_twist(
    table: FloatArray, frame: str, attitude: tuple[FloatArray, FloatArray] | None
) -> tuple[Motion | None, str | None]:
    """A twist is in the axes of its header's frame."""
    if attitude is None:
        return None, "velocities without any attitude (Imu, Odometry), so they are not used"
    stamps, velocity = table[:, 0], table[:, 1:4]
    attitudes = _latest(attitude[0], attitude[1], stamps)
    if not any(frame.lower().endswith(name) for name in _WORLD_FRAMES):
        velocity = np.array([matrix_from_rpy(rpy) @ v for rpy, v in zip(attitudes, velocity, strict=True)])
    return Motion(stamps, velocity, attitudes), None


def _latest(stamps: FloatArray, values: FloatArray, at_s: FloatArray) -> FloatArray:
    """Newest values ``(M, K)`` at the moments ``(M,)``; NaN if older than `_HOLD_S`."""
    index = np.searchsorted(stamps, at_s, side="right") - 1
    out = values[np.maximum(index, 0)].copy()
    out[(index < 0) | (at_s - stamps[np.maximum(index, 0)] > _HOLD_S)] = np.nan
    return out


def _fresh(table: FloatArray | None, at_s: FloatArray, hold_s: float = _HOLD_S) -> FloatArray:
    """Newest reading ``(M,)`` of a one-column table; NaN where there is no newer one since the moment before."""
    if table is None:
        return np.full(len(at_s), np.nan)
    index = np.searchsorted(table[:, 0], at_s, side="right") - 1
    out = table[np.maximum(index, 0), 1].copy()
    repeated = np.concatenate([[False], index[1:] == index[:-1]])
    out[(index < 0) | repeated | (at_s - table[np.maximum(index, 0), 0] > hold_s)] = np.nan
    return out


def _samples(motion: Motion, tables: Mapping[str, FloatArray]) -> list[TelemetrySample]:
    at_s = motion.stamps_s
    tof, battery = _fresh(tables.get("range"), at_s), _fresh(tables.get("battery"), at_s, math.inf)
    force = np.full((len(at_s), 3), np.nan)
    if "imu" in tables:
        force = _latest(tables["imu"][:, 0], tables["imu"][:, 5:8], at_s)
    return [
        TelemetrySample(
            float(at_s[i]),
            motion.velocity_m_s[i],
            motion.rpy_rad[i],
            tof_m=float(tof[i]),
            acceleration_m_s2=force[i],
            battery=float(battery[i]),
        )
        for i in range(len(at_s))
    ]
