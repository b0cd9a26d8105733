"""An IMU on the camera: metres per map unit, the vertical, and rotations between frames."""

import math
from collections.abc import Sequence
from copy import copy

import numpy as np

from edgeslam_torch.estimation.inertial.alignment import Alignment, align
from edgeslam_torch.estimation.inertial.preintegration import HELD_S, preintegrate
from edgeslam_torch.estimation.scale.belief import MOST_SIGMA, ScaleBelief
from edgeslam_torch.geometry.gyroscope_check import checked_against_rotation
from edgeslam_torch.geometry.rotations import fitted_rotation, smallest_rotation, vectors_from_matrices
from edgeslam_torch.imu import ImuModel, ImuReadings
from edgeslam_torch.noise import IMU_YOUNG_S
from edgeslam_torch.types import FloatArray

_LEAST_EXCITATION = 3.0
"""Minimum of `Alignment.excitation` of an observable scale."""
_NODE_S = 0.09
"""Minimum time between two poses of an alignment: those of images are given at 10 Hz."""
REACH_S = 60.0
"""Length of way that a fit in flight takes: a map's scale drifts over longer ones."""
_REFIT_S, _REFIT_SHARE = 0.2, 0.12
"""Time between fits, and as a share of the time so far: later fits cost more and change less."""
_MATURE_S = 10.0
"""Length of a way from which on the fit leaves out the map's first `IMU_YOUNG_S`, in which it bends."""
_CONTRADICTED_RAD = math.radians(3.0)
"""Size of the errors of visual rotations beyond which gyroscope and images do not move together; in flight they are
0.1 to 0.3 degrees."""
_CONTRADICTED_SHARE, _CONTRADICTED_M = 0.05, 0.03
"""The same for visual positions, of the extent of the way and in metres; in flight 0.01 and 0.01 to 0.02 m."""
_UPRIGHT_RAD = math.radians(1.2)
"""Maximum standard deviation of a vertical that levels the output."""
_RECENT = 30
"""Number of parts, one a frame, of a copy for a prediction: a second."""
_OFFSET_RANGE_S, _OFFSET_STEP_S = 0.5, 0.005
_LEAST_RATE_RAD_S = 0.05
"""Minimum standard deviation of the angular rate about a second axis, from which on it determines a mount: five times
the noise of visual rates."""
_LEAST_CORRELATION = 0.8
"""Minimum correlation of the angular rates of camera and IMU."""


class Imu:
    """Readings of one flight and what they say of its map.

    Args:
        model: Noise, mount and clock; what it does not say is estimated.
    """

    def __init__(self, model: ImuModel) -> None:
        self.model = model
        self.alignment: Alignment | None = None
        """Newest alignment with the present submap, whether or not its scale is observable."""
        self.fault = ""
        """Why readings and images do not move together; empty if they do."""
        self.forces: list[ImuReadings] = []
        """Readings of an accelerometer without a gyroscope, which determine the vertical only."""
        self._parts: list[ImuReadings] = []
        self._mount: tuple[FloatArray, float] | None = None
        if model.T_imu_cam is not None and model.time_offset_s is not None:
            self._mount = model.T_imu_cam[:3, :3], model.time_offset_s
        self._range_ends = np.full(6, np.inf)
        self._since_s = self._fitted_s = -math.inf

    def __len__(self) -> int:
        return sum(map(len, self._parts))

    def add(self, parts: Sequence[ImuReadings]) -> None:
        """Readings in temporal order."""
        self.forces = self.forces + [part for part in parts if not part.has_gyroscope]
        self._parts += [part for part in parts if len(part) and part.has_gyroscope]

    def enter_submap(self, stamp_s: float) -> None:
        """From a stamp on the camera is in another submap, of whose poses alone later fits are."""
        self._since_s, self.alignment = stamp_s, None

    def is_due(self, stamp_s: float) -> bool:
        """Whether enough time has passed since the last fit."""
        if not self._parts:
            return False
        began_s = max(self._since_s, self._parts[0].stamps_s[0])
        reach_s = min(REACH_S, stamp_s - began_s)
        return stamp_s - self._fitted_s >= max(_REFIT_S, _REFIT_SHARE * reach_s)

    def fit(self, stamps_s: FloatArray, T_m_c: FloatArray, whole: bool = False) -> None:
        """Align with the poses of images.

        Args:
            stamps_s: Increasing stamps ``(N,)`` at 10 Hz.
            T_m_c: Poses ``(N, 4, 4)`` in the camera's submap.
            whole: Of the whole flight, instead of the last seconds.
        """
        if not self._parts or len(stamps_s) == 0:
            return
        self._fitted_s = float(stamps_s[-1])
        reach_s = math.inf if whole else REACH_S
        margin_s = _OFFSET_RANGE_S if self._mount is None else abs(self._mount[1])
        first_s, began_s = max(stamps_s[-1] - reach_s, self._parts[0].stamps_s[0] + margin_s), float(stamps_s[0])
        if stamps_s[-1] - began_s > _MATURE_S:
            first_s = max(first_s, began_s + IMU_YOUNG_S)
        last_s = self._parts[-1].stamps_s[-1] - margin_s
        used = (stamps_s > first_s) & (stamps_s <= last_s + HELD_S)
        stamps_s, T_m_c = stamps_s[used], T_m_c[used]
        if len(stamps_s) < 2:
            return
        readings = self._between(stamps_s[0] - margin_s - 0.1, math.inf)
        exceeded = readings.largest > self._range_ends  # what repeated was the largest so far, not the end
        self._range_ends = np.where(exceeded, readings.range_ends, np.minimum(self._range_ends, readings.range_ends))
        if self._mount is None:
            self._mount = imu_mount(stamps_s, T_m_c[:, :3, :3], readings, self.model)
            if self._mount is None:
                return
        k = _spaced(stamps_s)
        found = None if self.alignment is None else self._aligned(stamps_s[k], T_m_c[k], readings, self.alignment)
        if found is None:  # the second time linearised at the first's biases and offset
            rough = self._aligned(stamps_s[k], T_m_c[k], readings, None)
            found = None if rough is None else self._aligned(stamps_s[k], T_m_c[k], readings, rough)
        self.fault = ""
        if found is not None and found.sigma_pose[0] > _CONTRADICTED_RAD:
            check = checked_against_rotation(readings, self.model, stamps_s, T_m_c[:, :3, :3])
            found, self.fault = None, check.fault or "the IMU contradicts the images"
        elif found is not None and found.excitation > _LEAST_EXCITATION and _misses(found):
            found, self.fault = None, "accelerations contradict the images: unit, axes, or clipped at the range's end?"
        self.alignment = found

    def _aligned(
        self, stamps_s: FloatArray, T_m_c: FloatArray, readings: ImuReadings, before: Alignment | None
    ) -> Alignment | None:
        assert self._mount is not None
        return align(stamps_s, T_m_c, readings, self.model, self._mount, before, self._range_ends)

    @property
    def scale(self) -> ScaleBelief | None:
        """Metres per map unit; None while it is not observable."""
        found = self.alignment
        if found is None or found.excitation < _LEAST_EXCITATION or not found.sigma_log_scale < MOST_SIGMA:
            return None
        return ScaleBelief(found.log_scale, found.sigma_log_scale, "imu")

    @property
    def up(self) -> tuple[FloatArray, float] | None:
        """The vertical ``(3,)`` in the map, and its standard deviation per axis [rad]."""
        found = self.alignment
        return None if found is None else (-found.gravity / np.linalg.norm(found.gravity), found.sigma_up_rad)

    def upright(self) -> FloatArray | None:
        """Rotation ``(3, 3)`` from the map to a world whose z is up, if the vertical is accurate."""
        if self.up is None or self.up[1] > _UPRIGHT_RAD:
            return None
        return smallest_rotation(self.up[0], np.array([0.0, 0.0, 1.0]))

    def turned(self, from_s: float, to_s: float) -> FloatArray | None:
        """Rotation ``R_c1_c0`` ``(3, 3)`` of the camera between two frames; None without readings or mount."""
        found = self.alignment
        if found is None:
            return None
        readings = self._between(from_s + found.offset_s - 0.05, to_s + found.offset_s + 0.05)
        if len(readings) < 2:
            return None
        moments = np.array([from_s, to_s]) + found.offset_s
        measured = preintegrate(readings, moments, found.bias[-1], self.model, self._range_ends)
        return found.R_i_c.T @ measured.R[0].T @ found.R_i_c if measured.complete[0] else None

    def frozen(self, readings: Sequence[ImuReadings] = ()) -> "Imu":
        """A copy for another thread, of the newest readings and of some since then."""
        other = copy(self)
        other._parts = self._parts[-_RECENT:]
        other.add(readings)
        return other

    def _between(self, after_s: float, until_s: float) -> ImuReadings:
        """Readings of a time."""
        first = len(self._parts)
        while first > 0 and self._parts[first - 1].stamps_s[-1] > after_s:
            first -= 1
        return ImuReadings.joined(self._parts[max(first - 1, 0) :]).between(after_s, until_s)

    def warnings(self) -> list[str]:
        """What could not be determined, and why."""
        if not self._parts:
            return []
        if self.fault:
            return [f"IMU not used: {self.fault}"]
        if self._mount is None:
            return [
                "the camera's rotation on the IMU is not observable yet: turn about two axes, or give T_imu_cam and "
                "time_offset_s"
            ]
        return [] if self.scale is not None else ["the scale is not observable from the IMU yet: it needs acceleration"]

    def statistics(self) -> dict[str, float]:
        """The newest alignment, for the report."""
        if not self._parts:
            return {}
        numbers: dict[str, float] = {"imu readings": len(self)}
        if (found := self.alignment) is not None:
            unit, mount = math.exp(found.log_scale), np.rad2deg(vectors_from_matrices(found.R_i_c))
            numbers |= {f"imu mount {axis} deg": float(angle) for axis, angle in zip("xyz", mount, strict=True)}
            numbers |= {
                "scale imu": unit,
                "scale imu sigma": unit * found.sigma_log_scale,
                "imu time offset s": found.offset_s,
                "imu time offset sigma s": found.sigma_offset_s,
                "imu excitation": found.excitation,
                "imu mount sigma deg": math.degrees(found.sigma_mount_rad),
                "imu visual error rad": found.sigma_pose[0],
                "imu visual error m": unit * found.sigma_pose[1],
            }
        return numbers


def _misses(found: Alignment) -> bool:
    """Whether the errors of visual positions are as large as only those of another motion."""
    error = found.sigma_pose[1]
    return error > _CONTRADICTED_SHARE * found.extent and error * math.exp(found.log_scale) > _CONTRADICTED_M


def _spaced(stamps_s: FloatArray) -> list[int]:
    """Indices of poses that are `_NODE_S` apart; the last one always."""
    chosen = [len(stamps_s) - 1]
    for k in range(len(stamps_s) - 2, -1, -1):
        if stamps_s[chosen[-1]] - stamps_s[k] >= _NODE_S:
            chosen.append(k)
    return chosen[::-1]


def imu_mount(
    stamps_s: FloatArray, R_m_c: FloatArray, readings: ImuReadings, model: ImuModel
) -> tuple[FloatArray, float] | None:
    """Rotation camera to IMU ``(3, 3)`` and time offset [s] by correlating angular rates.

    Args:
        stamps_s: Increasing stamps of images ``(N,)``.
        R_m_c: Rotations of the camera ``(N, 3, 3)``.
        readings: Readings.
        model: What is known.

    Returns:
        None if the motion does not determine them: there must be rotation about two axes that both sensors see.
    """
    dt = np.diff(stamps_s)
    near = dt < 0.3
    if near.sum() < 10:
        return None
    turned = vectors_from_matrices(np.swapaxes(R_m_c[:-1], 1, 2) @ R_m_c[1:])[near] / dt[near, None]
    turned -= np.median(turned, axis=0)
    steps = np.diff(readings.stamps_s)[:, None]
    rate = readings.angular_rate_rad_s
    angle = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * (rate[1:] + rate[:-1]) * steps, axis=0)])
    given = model.time_offset_s
    grid = np.arange(-_OFFSET_RANGE_S, _OFFSET_RANGE_S + 1e-9, _OFFSET_STEP_S) if given is None else np.array([given])
    cost, found = np.full(len(grid), np.inf), []
    for k, offset_s in enumerate(grid):
        moments = stamps_s + offset_s
        at = np.stack([np.interp(moments, readings.stamps_s, angle[:, i]) for i in range(3)], axis=1)
        rate_i = (np.diff(at, axis=0) / dt[:, None])[near]
        rate_i -= np.median(rate_i, axis=0)
        R = fitted_rotation(turned, rate_i) if model.T_imu_cam is None else model.T_imu_cam[:3, :3]
        cost[k] = float(np.sum((rate_i - turned @ R.T) ** 2))
        found.append((R, rate_i))
    best = int(np.argmin(cost))
    R, rate_i = found[best]
    spread = np.linalg.svd(rate_i, compute_uv=False) / math.sqrt(len(rate_i))
    correlation = float(np.sum(rate_i * (turned @ R.T))) / math.sqrt(
        float(np.sum(rate_i**2) * np.sum(turned**2)) + 1e-12
    )
    if spread[1] < _LEAST_RATE_RAD_S or correlation < _LEAST_CORRELATION:
        return None
    offset_s = float(grid[best])
    if 0 < best < len(grid) - 1:
        before, here, after = cost[best - 1 : best + 2]
        offset_s += 0.5 * _OFFSET_STEP_S * float((before - after) / (before - 2.0 * here + after))
    return R, offset_s
