"""A camera swung by hand, its telemetry's reader, and its poses in a map that has its own gauge."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.types import FloatArray

T_B_C = camera_on_body()


@dataclass(frozen=True)
class Gauge:
    """What a map has of a motion."""

    T_m_c: FloatArray
    T_m_w: FloatArray
    scale: float
    """Metres per map unit."""
    sigma_t: float
    sigma_r: float


@dataclass(frozen=True)
class Motion:
    """Camera poses at frame rate."""

    stamps_s: FloatArray
    T_w_c: FloatArray

    def in_gauge(self, rng, noise_m=0.003, noise_rad=0.002) -> Gauge:
        """The same poses as a monocular map has them: turned, shifted, scaled, noisy."""
        n = len(self.stamps_s)
        T = self.T_w_c.copy()
        T[:, :3, 3] += rng.normal(0, noise_m, (n, 3))
        T[:, :3, :3] = T[:, :3, :3] @ Rotation.from_rotvec(rng.normal(0, noise_rad, (n, 3))).as_matrix()
        T_m_w = np.eye(4)
        T_m_w[:3, :3] = Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix()
        T_m_w[:3, 3] = rng.normal(size=3)
        T = T_m_w @ T
        scale = float(np.exp(rng.uniform(-1, 1)))
        T[:, :3, 3] /= scale
        return Gauge(T, T_m_w, scale, noise_m / scale, noise_rad)


def swinging(duration_s=20.0, rate_hz=20.0, size_m=0.25) -> Motion:
    """A camera swung along three axes, turning a little."""
    t = np.arange(0.0, duration_s, 1.0 / rate_hz)
    p = size_m * np.stack([np.sin(1.7 * t), np.sin(1.3 * t + 1.0), 0.7 * np.sin(2.1 * t + 2.0)], axis=1)
    yaw, pitch = 0.3 * np.sin(0.7 * t), 0.08 * np.sin(1.1 * t)
    T_w_b = np.tile(np.eye(4), (len(t), 1, 1))
    T_w_b[:, :3, :3] = Rotation.from_euler("ZYX", np.stack([yaw, pitch, 0.0 * t], axis=1)).as_matrix()
    T_w_b[:, :3, 3] = p + [0.0, 0.0, 1.2]
    return Motion(t, T_w_b @ T_B_C)


def replay(fusion, motion, gauge, telemetry, tracked=lambda t: True, each=lambda t, i: None):
    """Give frames and packets in the order of their stamps."""
    sent = 0
    for i, t in enumerate(motion.stamps_s):
        end = sent
        while end < len(telemetry) and telemetry[end].stamp_s <= t:
            end += 1
        fusion.add_telemetry(telemetry[sent:end])
        sent = end
        each(float(t), i)
        fusion.add_visual(float(t), gauge.T_m_c[i], gauge.sigma_t, gauge.sigma_r, tracked(float(t)))
        if i % 15 == 0:
            fusion.scale()


def at_once(fusion, motion, gauge, telemetry):
    """Give a whole flight, in its map as it is at last: one fit instead of one a second."""
    fusion.add_telemetry(telemetry)
    fusion.add_earlier(motion.stamps_s, gauge.T_m_c, gauge.sigma_t, gauge.sigma_r)
    fusion.revise(motion.stamps_s, gauge.T_m_c)
