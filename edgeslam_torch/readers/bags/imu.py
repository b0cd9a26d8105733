"""IMU readings of a bag: ``sensor_msgs/Imu``, every message; a gyroscope's and an accelerometer's topic become one."""

import os
from collections.abc import Mapping, Sequence

import numpy as np

from edgeslam_torch.errors import SourceError
from edgeslam_torch.imu import ImuReadings
from edgeslam_torch.readers.bags.bag import Bag, Topic
from edgeslam_torch.readers.bags.clock import TopicClock, header_s
from edgeslam_torch.readers.imu.table import tidied
from edgeslam_torch.types import FloatArray

_PARTS = ("gyro", "accel")
"""In the names of RealSense's topics, each of which leaves the other sensor at zero."""


def choose_imu(topics: Sequence[Topic], image: str) -> tuple[tuple[str, ...], str | None]:
    """Topics of the IMU that belongs to a camera, and a remark if there are others: the name that has most in common
    with the pictures' topic, of equals the one with most messages.

    Args:
        topics: Those of ``sensor_msgs/Imu``.
        image: Topic of the pictures.
    """
    if not topics:
        return (), None
    count = {topic.name: topic.count for topic in topics}
    best = max(sorted(count), key=lambda name: (len(os.path.commonprefix([name, image])), count[name]))
    pairs = [tuple(best.replace(part, other) for other in _PARTS) for part in _PARTS if part in best]
    used = next((pair for pair in pairs if all(name in count for name in pair)), (best,))
    others = sorted(set(count) - set(used))
    if not others:
        return used, None
    return used, f"IMU readings are taken from {' and '.join(used)}; --topic imu={others[0]} changes that"


def read_bag_imu(
    bag: Bag, names: Sequence[str], clocks: Mapping[str, TopicClock]
) -> tuple[ImuReadings | None, list[str]]:
    """All readings, None without usable ones; and remarks.

    Args:
        bag: The recording.
        names: Of `choose_imu`.
        clocks: Topic to its clock.
    """
    rows: dict[str, list[tuple[float, ...]]] = {name: [] for name in names}
    for raw in bag.messages(list(names)) if names else ():
        message = bag.decode(raw)
        w, a = message.angular_velocity, message.linear_acceleration
        stamp_s = clocks[raw.topic].stamp(raw.received_s, header_s(message))
        rows[raw.topic].append((stamp_s, w.x, w.y, w.z, a.x, a.y, a.z))
    tables = [np.array(found, dtype=np.float64).reshape(-1, 7) for found in rows.values()]
    if not any(len(table) for table in tables):
        return None, []
    table = tables[0] if len(tables) == 1 else _together(*tables)
    label = " and ".join(names)
    try:
        readings, remarks = tidied(table[:, 0], table[:, 1:4], table[:, 4:], bool(table[:, 1:4].any()))
    except SourceError as error:
        return None, [f"{label}: not used as an IMU: {error}"]
    return readings, [f"{label}: {remark}" for remark in remarks]


def _together(gyroscope: FloatArray, accelerometer: FloatArray) -> FloatArray:
    """Accelerations interpolated at the gyroscope's stamps, where there are both."""
    accelerometer = accelerometer[np.argsort(accelerometer[:, 0], kind="stable")]
    if not len(accelerometer):
        return gyroscope
    at_s = gyroscope[:, 0]
    both = gyroscope[(at_s >= accelerometer[0, 0]) & (at_s <= accelerometer[-1, 0])].copy()
    for column in (4, 5, 6):
        both[:, column] = np.interp(both[:, 0], accelerometer[:, 0], accelerometer[:, column])
    return both
