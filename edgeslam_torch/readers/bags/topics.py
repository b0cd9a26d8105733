"""Roles of a bag's topics, by type and by ``--topic``."""

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from edgeslam_torch.errors import SourceError
from edgeslam_torch.readers.bags.bag import Bag, Topic
from edgeslam_torch.readers.bags.imu import choose_imu
from edgeslam_torch.readers.bags.pictures import THERMAL, depth_format

IMAGE, CAMERA = "image", "camera"
TELEMETRY = ("tello", "odom", "velocity", "imu", "range", "battery")
"""Roles of telemetry, in the order in which one is preferred as the source of velocity."""
_ROLES = {
    "sensor_msgs/Image": IMAGE,
    "sensor_msgs/CompressedImage": IMAGE,
    "sensor_msgs/CameraInfo": CAMERA,
    "nav_msgs/Odometry": "odom",
    "geometry_msgs/TwistStamped": "velocity",
    "geometry_msgs/TwistWithCovarianceStamped": "velocity",
    "sensor_msgs/Imu": "imu",
    "sensor_msgs/Range": "range",
    "sensor_msgs/BatteryState": "battery",
}
_MESSAGE_OF_THE_DRIVER = "FlightData"
"""tello_msgs/FlightData, in whichever package a driver defines it."""
_NOTHING = "none"
_COMPRESSED = "/compressed"
_OURS = "/edgeslam/"
"""Prefix of results of ``--save-mcap``, which are not measurements."""


@dataclass(frozen=True, slots=True)
class Choice:
    """The topics that a run uses."""

    image: str
    camera: str | None
    telemetry: Mapping[str, str]
    """Role to topic."""
    asked: frozenset[str] = frozenset()
    """Roles that were named by ``--topic``."""
    remarks: tuple[str, ...] = ()
    imu: tuple[str, ...] = ()
    """Topics of the IMU beside the camera, see `edgeslam_torch.readers.bags.imu.choose_imu`."""


def role_of(topic: Topic) -> str | None:
    """Role of a topic by its type; None without one."""
    if topic.name.startswith(_OURS):
        return None
    if topic.kind.rpartition("/")[2] == _MESSAGE_OF_THE_DRIVER:
        return "tello"
    return _ROLES.get(topic.kind)


def depth_of(bag: Bag, topic: Topic) -> str | None:
    """Format of a topic of depth maps; None for ordinary pictures."""
    if "compressedDepth" in topic.name:
        return "compressedDepth"
    first = bag.first(topic.name, 1) if topic.count else []
    return depth_format(first[0][1]) if first else None


def choose(bag: Bag, wanted: Sequence[str] = ()) -> Choice:
    """The topics to use.

    Args:
        bag: The recording.
        wanted: As given to ``--topic``: ``/name``, whose type says what it is, ``role=/name``, or ``role=none``.

    Raises:
        SourceError: If a topic does not exist or cannot be what it was given for, or the camera is not clear.
    """
    requests = _requests(bag, wanted)
    image = _image(bag, requests.get(IMAGE))
    imus = [topic for topic in bag.topics if role_of(topic) == "imu" and topic.count]
    if (named := requests.get("imu")) is not None:
        imus = [topic for topic in imus if topic.name == named]
    imu, said = choose_imu(imus, image)
    telemetry, remarks = _telemetry(bag, requests | ({"imu": imu[0]} if imu else {}))
    remarks += [] if said is None else [said]
    asked = frozenset(role for role, name in requests.items() if name != _NOTHING)
    if depth_of(bag, next(topic for topic in bag.topics if topic.name == image)) == THERMAL:
        remarks.append(
            f"{image}: {THERMAL} is read as 16-bit pictures, since the topic was named; depth maps have the same format"
        )
    return Choice(image, _camera(bag, image, requests.get(CAMERA)), telemetry, asked, tuple(remarks), imu)


def _requests(bag: Bag, wanted: Sequence[str]) -> dict[str, str]:
    topics = {topic.name: topic for topic in bag.topics}
    requests: dict[str, str] = {}
    for request in wanted:
        role, equals, name = request.rpartition("=")
        if equals and role not in (IMAGE, CAMERA, *TELEMETRY):
            raise SourceError(
                f"--topic {request}: no role {role!r}; there are {', '.join((IMAGE, CAMERA, *TELEMETRY))}"
            )
        if equals and name == _NOTHING and role != IMAGE:
            requests[role] = _NOTHING
            continue
        if name not in topics:
            close = difflib.get_close_matches(name, topics, n=1, cutoff=0.5)
            hint = f"did you mean {close[0]}?" if close else f"list them with: edgeslam topics {bag.path}"
            raise SourceError(f"--topic {request}: {bag.path.name} has no topic {name!r}; {hint}")
        can_be = role_of(topics[name])
        if can_be is None or (equals and can_be != role):
            what = f"a {role} topic" if equals else "of a type that is used"
            raise SourceError(f"--topic {request}: {topics[name].kind} is not {what}; see edgeslam topics {bag.path}")
        if can_be in requests:
            raise SourceError(f"--topic {request}: {requests[can_be]} was given as {can_be} already; give one")
        requests[can_be] = name
    return requests


def _image(bag: Bag, request: str | None) -> str:
    candidates = [topic for topic in bag.topics if role_of(topic) == IMAGE]
    if request is not None:
        form = depth_of(bag, next(topic for topic in candidates if topic.name == request))
        if form not in (None, THERMAL):
            raise SourceError(f"--topic {request}: depth maps ({form}), not a camera's pictures")
        return request
    filled = [topic for topic in candidates if topic.count]
    forms = {topic.name: depth_of(bag, topic) for topic in filled}
    cameras = {name for name, form in forms.items() if form is None}
    # A driver publishes the same pictures raw and compressed.
    cameras = {name for name in cameras if _raw(name) == name or _raw(name) not in cameras}
    if len(cameras) == 1:
        return cameras.pop()
    if cameras:
        names = sorted(cameras)
        listing = ", ".join(names[:6]) + (", ..." if len(names) > 6 else "")
        count = {2: "two", 3: "three", 4: "four"}.get(len(names), str(len(names)))
        raise SourceError(f"{bag.path}: {count} cameras ({listing}); choose one, such as --topic {names[0]}")
    if forms:
        name, form = next(iter(forms.items()))
        thermal = f"; if they are a thermal camera's pictures: --topic {name}" if form == THERMAL else ""
        raise SourceError(f"{bag.path}: depth maps only ({name}: {form}); a camera's pictures are needed{thermal}")
    kinds = ", ".join(sorted({topic.kind for topic in bag.topics})[:5]) or "nothing"
    raise SourceError(f"{bag.path}: no pictures in it (found {kinds}); needed: sensor_msgs/Image or CompressedImage")


def _raw(name: str) -> str:
    return name.removesuffix(_COMPRESSED)


def _camera(bag: Bag, image: str, request: str | None) -> str | None:
    """The ``CameraInfo`` beside the pictures; with one camera in the bag, the only one there is."""
    if request is not None:
        return None if request == _NOTHING else request
    infos = [topic.name for topic in bag.topics if role_of(topic) == CAMERA and topic.count]
    beside = _raw(image).rpartition("/")[0] + "/camera_info"
    if beside in infos:
        return beside
    cameras = {_raw(t.name).rpartition("/")[0] for t in bag.topics if role_of(t) == IMAGE and t.count}
    return infos[0] if len(infos) == 1 and len(cameras) == 1 else None


def _telemetry(bag: Bag, requests: Mapping[str, str]) -> tuple[dict[str, str], list[str]]:
    """Topic of each role, and remarks about topics that are ignored because there are several."""
    chosen: dict[str, str] = {}
    remarks = []
    for role in TELEMETRY:
        if role in requests:
            if requests[role] != _NOTHING:
                chosen[role] = requests[role]
            continue
        names = [topic.name for topic in bag.topics if role_of(topic) == role and topic.count]
        if len(names) == 1:
            chosen[role] = names[0]
        elif names:
            remarks.append(f"none of {', '.join(names)} is used as {role}; choose with --topic {role}={names[0]}")
    return chosen, remarks
