"""An IMU's readings along a trajectory, with noise, bias walk, mount, clock offset and range.

For simulated flights and for the ground truth of recordings. The path is a quintic spline of the poses, so angular
rate and acceleration are its exact derivatives.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline, make_lsq_spline
from scipy.spatial.transform import Rotation

from edgeslam_torch.geometry import se3
from edgeslam_torch.imu import ImuModel, ImuReadings
from edgeslam_torch.noise import GRAVITY_M_S2
from edgeslam_torch.types import FloatArray

_DEGREE = 5

MPU6050 = ImuModel(source="InvenSense MPU-6050, vibrating")
"""The default of `ImuModel`."""
ADIS16448 = ImuModel(1.6968e-4, 1.9393e-5, 2.0e-3, 3.0e-3, source="Analog Devices ADIS16448 as in EuRoC")
"""https://projects.asl.ethz.ch/datasets/doku.php?id=kmavvisualinertialdatasets, ``imu0/sensor.yaml``."""


@dataclass(frozen=True, slots=True)
class ImuErrors:
    """Errors beyond the model's noise densities."""

    noise: float = 1.0
    """Factor on the model's noise and bias walk; 0 for none."""
    gyroscope_bias_rad_s: float = 0.01
    accelerometer_bias_m_s2: float = 0.05
    """Standard deviations of the biases when it is switched on."""
    gyroscope_range_rad_s: float = math.inf
    accelerometer_range_m_s2: float = math.inf
    """Larger values are clipped."""


EXACT = ImuErrors(0.0, 0.0, 0.0)


def simulate_imu(
    rng: np.random.Generator,
    stamps_s: FloatArray,
    T_w_c: FloatArray,
    model: ImuModel,
    *,
    errors: ImuErrors | None = None,
    knots_s: float | None = None,
) -> ImuReadings:
    """Readings of an IMU mounted rigidly to the camera.

    Args:
        rng: Noise.
        stamps_s: ``(F,)`` increasing times of the poses on the camera's clock [s].
        T_w_c: ``(F, 4, 4)`` camera to a world whose z axis points up [m].
        model: Noise, rate, mount and clock; an unknown mount or offset is none.
        errors: Biases, range.
        knots_s: Distance of the spline's knots for noisy poses, which it then does not pass through but fits; None
            interpolates.

    Returns:
        Readings from the first pose to the last, stamped by the IMU's clock.

    Raises:
        ValueError: If there are fewer than eight poses or the stamps do not increase.
    """
    errors = errors or ImuErrors()
    t = np.asarray(stamps_s, dtype=np.float64)
    if len(t) <= _DEGREE + 2 or np.any(np.diff(t) <= 0):
        raise ValueError(f"an IMU needs at least {_DEGREE + 3} poses with increasing stamps, got {len(t)}")
    T_w_imu = T_w_c if model.T_imu_cam is None else T_w_c @ se3.inverse(model.T_imu_cam)
    path = _spline(t - t[0], T_w_imu[:, :3, 3], knots_s)
    turn = _spline(t - t[0], _continuous(Rotation.from_matrix(T_w_imu[:, :3, :3]).as_quat()), knots_s)
    dt = 1.0 / model.rate_hz
    moments = np.arange(0.0, t[-1] - t[0], dt)
    q, dq = turn(moments), turn(moments, nu=1)
    rate = 2.0 * _product(q * [-1.0, -1.0, -1.0, 1.0], dq)[:, :3] / np.sum(q * q, axis=1, keepdims=True)
    force = Rotation.from_quat(q).inv().apply(path(moments, nu=2) + [0.0, 0.0, GRAVITY_M_S2])
    gyroscope = model.gyroscope_noise_density, model.gyroscope_random_walk, errors.gyroscope_bias_rad_s
    accelerometer = model.accelerometer_noise_density, model.accelerometer_random_walk, errors.accelerometer_bias_m_s2
    ranges = errors.gyroscope_range_rad_s, errors.accelerometer_range_m_s2
    rate, force = (
        np.clip(values + _errors(rng, values.shape, dt, *sigmas, errors.noise), -end, end)
        for values, sigmas, end in zip((rate, force), (gyroscope, accelerometer), ranges, strict=True)
    )
    return ImuReadings(t[0] + moments + (model.time_offset_s or 0.0), rate, force)


def mounted(model: ImuModel, T_imu_cam: FloatArray, time_offset_s: float = 0.0, rate_hz: float = 200.0) -> ImuModel:
    """A model with mount, clock and rate."""
    return replace(model, T_imu_cam=T_imu_cam, time_offset_s=time_offset_s, rate_hz=rate_hz)


def _spline(t: FloatArray, values: FloatArray, knots_s: float | None) -> BSpline:
    if knots_s is None:
        return make_interp_spline(t, values, k=_DEGREE)
    inner = np.linspace(0.0, t[-1], max(2, round(t[-1] / knots_s) + 1))
    # Knots without a pose between them would leave the spline undetermined there.
    inner = inner[[0, *(1 + np.flatnonzero(np.diff(np.searchsorted(t, inner[:-1])) > 0)), -1]]
    return make_lsq_spline(t, values, np.pad(inner, _DEGREE, mode="edge"), k=_DEGREE)


def _continuous(q: FloatArray) -> FloatArray:
    """Quaternions ``(N, 4)`` with signs by which each is near the one before."""
    signs = np.where(np.sum(q[1:] * q[:-1], axis=1) < 0, -1.0, 1.0)
    return q * np.cumprod([1.0, *signs])[:, None]


def _product(a: FloatArray, b: FloatArray) -> FloatArray:
    """Product of quaternions ``(N, 4)``, x y z w."""
    vector = a[:, 3:] * b[:, :3] + b[:, 3:] * a[:, :3] + np.cross(a[:, :3], b[:, :3])
    return np.column_stack([vector, a[:, 3] * b[:, 3] - np.sum(a[:, :3] * b[:, :3], axis=1)])


def _errors(
    rng: np.random.Generator, shape: tuple[int, ...], dt: float, density: float, walk: float, bias: float, scale: float
) -> FloatArray:
    """White noise, and a bias that walks from where it is switched on; ``(N, 3)``."""
    white, steps = rng.standard_normal(shape), rng.standard_normal(shape)
    start = bias * rng.standard_normal(3)
    return scale * density / math.sqrt(dt) * white + start + scale * walk * math.sqrt(dt) * np.cumsum(steps, axis=0)
