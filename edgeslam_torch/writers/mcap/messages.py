"""ROS 2 messages of poses, maps and pictures.

Frames: ``map`` is the trajectory's world (z up), ``camera`` the camera's optical frame (x right, y down, z forward),
``imu`` the IMU's own.
"""

from collections.abc import Iterable, Mapping
from typing import Any, Protocol

import cv2
import numpy as np

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.types import FloatArray, PointCloud

MAP, CAMERA, IMU = "map", "camera", "imu"
UNKNOWN = 1e9
"""Variance of what is not known; ROS has no word for it in Odometry."""
_JPEG_QUALITY = 80
_FLOAT32, _UINT32 = 7, 6
"""Codes of ``sensor_msgs/PointField``."""


class Maker(Protocol):
    """Makes messages, see `edgeslam_torch.writers.mcap.ros_file.RosFile.make`."""

    def make(self, kind: str, **fields: Any) -> Any: ...


def header(ros: Maker, stamp_s: float, frame: str = MAP) -> Any:
    """``std_msgs/Header``."""
    sec, nanosec = divmod(max(0, round(stamp_s * 1e9)), 10**9)
    time = ros.make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
    return ros.make("std_msgs/msg/Header", stamp=time, frame_id=frame)


def _xyz(ros: Maker, kind: str, v: Iterable[float]) -> Any:
    x, y, z = (float(c) for c in v)
    return ros.make(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)


def _turn(ros: Maker, T: FloatArray) -> Any:
    x, y, z, w = (float(c) for c in se3.pose_to_tum(T)[3:])
    return ros.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def _pose(ros: Maker, T: FloatArray) -> Any:
    return ros.make("geometry_msgs/msg/Pose", position=_xyz(ros, "Point", T[:3, 3]), orientation=_turn(ros, T))


def transform(ros: Maker, stamp_s: float, T_w_c: FloatArray) -> Any:
    """``/tf`` from ``map`` to ``camera``."""
    moved = ros.make(
        "geometry_msgs/msg/Transform", translation=_xyz(ros, "Vector3", T_w_c[:3, 3]), rotation=_turn(ros, T_w_c)
    )
    one = ros.make(
        "geometry_msgs/msg/TransformStamped",
        header=header(ros, stamp_s),
        child_frame_id=CAMERA,
        transform=moved,
    )
    return ros.make("tf2_msgs/msg/TFMessage", transforms=[one])


def odometry(
    ros: Maker, stamp_s: float, T_w_c: FloatArray, velocity_w: FloatArray | None, covariance: FloatArray | None
) -> Any:
    """``nav_msgs/Odometry`` of the camera.

    Args:
        ros: Makes messages.
        stamp_s: Of the frame.
        T_w_c: ``(4, 4)``.
        velocity_w: ``(3,)`` in world axes; the message has it in the camera's, as ROS defines. None: unknown.
        covariance: ``(9, 9)`` of position, rotation vector and velocity in world axes. None: unknown.
    """
    of_pose: FloatArray = np.eye(6) * UNKNOWN
    of_twist: FloatArray = np.eye(6) * UNKNOWN
    R_c_w = T_w_c[:3, :3].T
    velocity = np.zeros(3) if velocity_w is None else R_c_w @ velocity_w
    if covariance is not None:
        of_pose = covariance[:6, :6]
        if velocity_w is not None and np.isfinite(covariance[6:, 6:]).all():
            of_twist[:3, :3] = R_c_w @ covariance[6:, 6:] @ R_c_w.T
    linear, angular = _xyz(ros, "Vector3", velocity), _xyz(ros, "Vector3", np.zeros(3))
    twist = ros.make("geometry_msgs/msg/Twist", linear=linear, angular=angular)
    return ros.make(
        "nav_msgs/msg/Odometry",
        header=header(ros, stamp_s),
        child_frame_id=CAMERA,
        pose=ros.make("geometry_msgs/msg/PoseWithCovariance", pose=_pose(ros, T_w_c), covariance=_flat(of_pose)),
        twist=ros.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=_flat(of_twist)),
    )


def _flat(covariance: FloatArray) -> FloatArray:
    return np.nan_to_num(covariance, nan=UNKNOWN, posinf=UNKNOWN).astype(np.float64).ravel()


def path(ros: Maker, stamp_s: float, stamps_s: FloatArray, T_w_c: FloatArray) -> Any:
    """``nav_msgs/Path`` of poses ``(F, 4, 4)`` at ``(F,)``."""
    poses = [
        ros.make("geometry_msgs/msg/PoseStamped", header=header(ros, float(t)), pose=_pose(ros, T))
        for t, T in zip(stamps_s, T_w_c, strict=True)
    ]
    return ros.make("nav_msgs/msg/Path", header=header(ros, stamp_s), poses=poses)


def cloud(ros: Maker, stamp_s: float, points: PointCloud) -> Any:
    """``sensor_msgs/PointCloud2`` with ``x y z rgb sigma observations``."""
    layout = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4"), ("sigma", "<f4"), ("observations", "<u4")]
    rows = np.zeros(len(points.p_w), dtype=layout)
    for i, axis in enumerate("xyz"):
        rows[axis] = points.p_w[:, i]
    colour = points.colour.astype(np.uint32)
    rows["rgb"] = (colour[:, 0] << 16) | (colour[:, 1] << 8) | colour[:, 2]  # PCL's packing; read as float bits
    rows["sigma"], rows["observations"] = points.sigma_m, points.observations
    fields = [
        ros.make(
            "sensor_msgs/msg/PointField",
            name=name,
            offset=4 * i,
            datatype=_UINT32 if name == "observations" else _FLOAT32,
            count=1,
        )
        for i, (name, _) in enumerate(layout)
    ]
    return ros.make(
        "sensor_msgs/msg/PointCloud2",
        header=header(ros, stamp_s),
        height=1,
        width=len(rows),
        fields=fields,
        is_bigendian=False,
        point_step=rows.dtype.itemsize,
        row_step=rows.nbytes,
        data=rows.view(np.uint8).ravel(),
        is_dense=True,
    )


def imu(ros: Maker, stamp_s: float, rate: FloatArray, force: FloatArray) -> Any:
    """``sensor_msgs/Imu`` of one reading, ``(3,)`` [rad/s] and ``(3,)`` [m/s^2]; NaN where not measured."""
    unknown, known = np.array([-1.0, *[0.0] * 8]), np.zeros(9)
    return ros.make(
        "sensor_msgs/msg/Imu",
        header=header(ros, stamp_s, IMU),
        orientation=_turn(ros, np.eye(4)),
        orientation_covariance=unknown,
        angular_velocity=_xyz(ros, "Vector3", np.nan_to_num(rate)),
        angular_velocity_covariance=known if np.isfinite(rate).all() else unknown,
        linear_acceleration=_xyz(ros, "Vector3", force),
        linear_acceleration_covariance=known,
    )


def picture(ros: Maker, stamp_s: float, image: np.ndarray) -> Any:
    """``sensor_msgs/CompressedImage`` (JPEG) of ``(H, W, 3)`` BGR or ``(H, W)`` grey."""
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    at = header(ros, stamp_s, CAMERA)
    return ros.make("sensor_msgs/msg/CompressedImage", header=at, format="jpeg", data=np.asarray(data).ravel())


def camera_info(ros: Maker, stamp_s: float, camera: Camera) -> Any:
    """``sensor_msgs/CameraInfo`` of the undistorted pictures."""
    P = np.hstack([camera.K, np.zeros((3, 1))])
    roi = ros.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return ros.make(
        "sensor_msgs/msg/CameraInfo",
        header=header(ros, stamp_s, CAMERA),
        height=camera.height,
        width=camera.width,
        distortion_model="plumb_bob",
        d=np.zeros(5),
        k=camera.K.ravel(),
        r=np.eye(3).ravel(),
        p=P.ravel(),
        binning_x=0,
        binning_y=0,
        roi=roi,
    )


def number(ros: Maker, value: float) -> Any:
    """``std_msgs/Float64``."""
    return ros.make("std_msgs/msg/Float64", data=float(value))


def diagnostics(ros: Maker, stamp_s: float, parts: Iterable[tuple[str, int, str, Mapping[str, object]]]) -> Any:
    """``diagnostic_msgs/DiagnosticArray`` of name, level (0 right, 1 warning, 2 error), words and values."""
    status = [
        ros.make(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=level,
            name=name,
            message=words,
            hardware_id="edgeslam",
            values=[
                ros.make("diagnostic_msgs/msg/KeyValue", key=key, value=str(value)) for key, value in values.items()
            ],
        )
        for name, level, words, values in parts
    ]
    return ros.make("diagnostic_msgs/msg/DiagnosticArray", header=header(ros, stamp_s, ""), status=status)
