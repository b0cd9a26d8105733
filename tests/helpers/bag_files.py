"""Bags written by others' libraries: MCAP by mcap-ros2-support, ROS 1 and SQLite by rosbags."""

import math
from typing import Any

import numpy as np

HEADER = "std_msgs/Header header\n"
_RULE = "=" * 80 + "\n"
_STANDARD = {
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance\n",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance\n",
    "sensor_msgs/RegionOfInterest": "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify\n",
}
DEFINITIONS = {
    "sensor_msgs/msg/Image": HEADER
    + "uint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data\n",
    "sensor_msgs/msg/CompressedImage": HEADER + "string format\nuint8[] data\n",
    "sensor_msgs/msg/CameraInfo": HEADER
    + "uint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\nfloat64[9] r\nfloat64[12] p\n"
    "uint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi\n",
    "nav_msgs/msg/Odometry": HEADER
    + "string child_frame_id\ngeometry_msgs/PoseWithCovariance pose\ngeometry_msgs/TwistWithCovariance twist\n",
    "geometry_msgs/msg/TwistStamped": HEADER + "geometry_msgs/Twist twist\n",
    "sensor_msgs/msg/Imu": HEADER + "geometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n"
    "geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n"
    "geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance\n",
    "sensor_msgs/msg/Range": HEADER
    + "uint8 radiation_type\nfloat32 field_of_view\nfloat32 min_range\nfloat32 max_range\nfloat32 range\n",
    "sensor_msgs/msg/BatteryState": HEADER + "float32 voltage\nfloat32 percentage\n",
    "tello_msgs/msg/FlightData": HEADER
    + "string raw\nuint8 sdk\nint64 pitch\nint64 roll\nint64 yaw\nint64 vgx\nint64 vgy\nint64 vgz\n"
    "int64 tof\nint64 h\nint64 bat\nfloat64 baro\nfloat64 agx\nfloat64 agy\nfloat64 agz\n",
    "std_msgs/msg/String": "string data\n",
}
"""Fields of the messages, as their packages define them (BatteryState: a driver's short form)."""

Event = tuple[str, str, float, dict[str, Any]]
"""Topic, type, time of receipt [s], message."""


def stamp(t):
    """``builtin_interfaces/Time``."""
    ns = round(t * 1e9)
    return {"sec": ns // 10**9, "nanosec": ns % 10**9}


def header(t, frame=""):
    return {"stamp": stamp(t), "frame_id": frame}


def picture(t, pixels, encoding):
    """``sensor_msgs/Image`` of an array ``(H, W)`` or ``(H, W, C)``."""
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
    height, width = pixels.shape[:2]
    return {
        "header": header(t, "camera"),
        "height": height,
        "width": width,
        "encoding": encoding,
        "is_bigendian": 0,
        "step": rows.shape[1],
        "data": rows.tobytes(),
    }


def pixels(index, shape=(48, 64, 3)):
    """The ``index``-th picture of a bag: noise."""
    return np.random.default_rng(index).integers(0, 256, shape, dtype=np.uint8)


def pictures(stamps, topic="/cam/image_raw", late_s=0.01, received=None, first=0):
    """Events of pictures with header stamps; received ``late_s`` later, or at the times given."""
    received = [t + late_s for t in stamps] if received is None else received
    return [
        (topic, "sensor_msgs/msg/Image", at, picture(t, pixels(first + i), "bgr8"))
        for i, (t, at) in enumerate(zip(stamps, received, strict=True))
    ]


def in_order(*series):
    """Events of several topics by time of receipt."""
    return sorted((event for events in series for event in events), key=lambda event: event[2])


def compressed(t, data, form):
    return {"header": header(t, "camera"), "format": form, "data": data}


def camera_info(size, f, d=(), model="plumb_bob"):
    width, height = size
    k = [f, 0.0, (width - 1) / 2, 0.0, f, (height - 1) / 2, 0.0, 0.0, 1.0]
    roi = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
    p = [k[0], 0.0, k[2], 0.0, 0.0, k[4], k[5], 0.0, 0.0, 0.0, 1.0, 0.0]
    info = {"header": header(0.0), "height": height, "width": width, "distortion_model": model, "d": list(d), "k": k}
    return info | {"r": np.eye(3).ravel().tolist(), "p": p, "binning_x": 0, "binning_y": 0, "roi": roi}


def xyz(v):
    return dict(zip("xyz", map(float, v), strict=True))


def quaternion(yaw):
    return {"x": 0.0, "y": 0.0, "z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}


def odometry(t, p, yaw, v, child="base_link"):
    pose = {"position": xyz(p), "orientation": quaternion(yaw)}
    twist = {"linear": xyz(v), "angular": xyz((0, 0, 0))}
    return {
        "header": header(t, "odom"),
        "child_frame_id": child,
        "pose": {"pose": pose, "covariance": [0.0] * 36},
        "twist": {"twist": twist, "covariance": [0.0] * 36},
    }


def twist(t, v, frame):
    return {"header": header(t, frame), "twist": {"linear": xyz(v), "angular": xyz((0, 0, 0))}}


def imu(t, yaw, force=(0.0, 0.0, 9.81), known=True):
    zero = [0.0] * 9
    return {
        "header": header(t, "base_link"),
        "orientation": quaternion(yaw),
        "orientation_covariance": zero if known else [-1.0] + zero[1:],
        "angular_velocity": xyz((0, 0, 0)),
        "angular_velocity_covariance": zero,
        "linear_acceleration": xyz(force),
        "linear_acceleration_covariance": zero,
    }


def write_mcap(path, events):
    """MCAP by mcap-ros2-support, which has its own CDR encoder."""
    from mcap_ros2.writer import Writer

    schemas = {}
    with path.open("wb") as file:
        writer = Writer(file)
        for topic, kind, t, message in events:
            if kind not in schemas:
                schemas[kind] = writer.register_msgdef(kind, definition(kind))
            writer.write_message(topic, schemas[kind], message, log_time=round(t * 1e9))
        writer.finish()
    return path


def definition(kind):
    """Text of a message type, followed by those of its parts."""
    parts, text = [DEFINITIONS[kind]], ""
    seen = []
    while parts:
        text += parts[0] if not text else ""
        for line in parts.pop(0).splitlines():
            part = line.split()[0].split("[")[0]
            if part in _STANDARD and part not in seen:
                seen.append(part)
                parts.append(_STANDARD[part])
    return text + "".join(f"{_RULE}MSG: {part}\n{_STANDARD[part]}" for part in seen)


def write_ros1(path, events, packed=False):
    """``.bag`` by rosbags, compressed by bzip2 or not."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    writer = Writer(path)
    if packed:
        writer.set_compression(Writer.CompressionFormat.BZ2)
    with writer:
        _write(writer, store, store.serialize_ros1, events)
    return path


def write_ros2(path, events, packed=None):
    """Folder with ``metadata.yaml`` and ``.db3`` by rosbags; packed by ``MESSAGE`` or ``FILE``."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    writer = Writer(path, version=8)
    if packed is not None:
        writer.set_compression(CompressionMode[packed], CompressionFormat.ZSTD)
    with writer:
        _write(writer, store, store.serialize_cdr, events)
    return path


def _write(writer, store, serialise, events):
    connections = {}
    for topic, kind, t, message in events:
        if topic not in connections:
            connections[topic] = writer.add_connection(topic, kind, typestore=store)
        writer.write(connections[topic], round(t * 1e9), serialise(_record(store, kind, message), kind))


def _record(store, kind, fields):
    """A message of rosbags from plain dictionaries."""
    made = {}
    for name, description in store.fielddefs[kind][1]:
        value = fields.get(name, fields.get(name.lower()))
        node, detail = int(description[0]), description[1]
        if node == 2 and isinstance(detail, str):
            value = _record(store, detail, value or {})
        elif node in (3, 4):
            item = detail[0][1][0] if isinstance(detail[0][1], tuple) else detail[0][1]
            size = detail[1] if node == 3 else 0
            if isinstance(value, bytes):
                value = np.frombuffer(value, np.uint8)
            elif item != "string":
                value = np.array([0] * size if value is None else value, dtype=item)
            else:
                value = value or []
        elif value is None:
            value = "" if (detail[0] if isinstance(detail, tuple) else detail) == "string" else 0
        made[name] = value
    return store.types[kind](**made)
