"""Readings as arrays: of all samples, however they came in, and of a copy as of its original."""

from dataclasses import fields

import numpy as np
import pytest

from edgeslam_torch.estimation.telemetry.track import Readings, TelemetryTrack, Turn
from edgeslam_torch.types import TelemetrySample


def sample(rng: np.random.Generator, k: int) -> TelemetrySample:
    velocity = np.full(3, np.nan) if k % 17 == 3 else np.round(rng.normal(size=3), 1)
    rpy = np.full(3, np.nan) if k % 17 == 5 else rng.normal(size=3)
    return TelemetrySample(0.1 * k, velocity, rpy, *rng.normal(size=3), np.zeros(3), 0.8)


def values(readings: Readings) -> dict[str, np.ndarray]:
    return {field.name: getattr(readings, field.name) for field in fields(Readings)}


def test_readings_do_not_depend_on_the_batching_of_samples() -> None:
    """More than the first array holds, asked for in between or not."""
    samples = [sample(np.random.default_rng(k), k) for k in range(700)]
    at_once, one_by_one = (TelemetryTrack("world", 0.35) for _ in range(2))
    at_once.add(samples)
    for one in samples:
        one_by_one.add([one])
        assert one_by_one.readings.stamp_s[-1] == one.stamp_s
    for name, value in values(one_by_one.readings).items():
        np.testing.assert_array_equal(value, values(at_once.readings)[name], err_msg=name)
    for name, field in (("tof", "tof_m"), ("height", "height_m"), ("baro", "baro_m")):
        np.testing.assert_array_equal(values(at_once.readings)[name], [getattr(s, field) for s in samples])


def test_samples_beyond_the_buffer_are_dropped() -> None:
    track = TelemetryTrack("world", 0.35, keep_s=30.0)
    samples = [sample(np.random.default_rng(k), k) for k in range(700)]
    for one in samples:
        track.add([one])
    kept = track.readings
    assert len(kept.stamp_s) == len(track) and 30.0 >= kept.stamp_s[-1] - kept.stamp_s[0] > 26.0
    np.testing.assert_array_equal(kept.tof, [s.tof_m for s in samples[-len(track) :]])


@pytest.mark.parametrize("turn", Turn)
def test_copy_is_equal_and_independent(turn: Turn) -> None:
    track = TelemetryTrack("world", 0.35)
    samples = [sample(np.random.default_rng(k), k) for k in range(206)]
    track.add(samples[:200])
    track.read_as(turn)
    copied = track.copy()
    before = values(track.readings)
    track.add(samples[200:205])
    for name, value in values(copied.readings).items():
        np.testing.assert_array_equal(value, before[name], err_msg=name)
    copied.add([sample(np.random.default_rng(1), 300)])
    track.add(samples[205:])
    np.testing.assert_array_equal(track.readings.tof, [s.tof_m for s in samples])
    assert len(copied.readings.stamp_s) == 201


@pytest.mark.parametrize("climbs", [True, False])
def test_a_steady_climb_is_no_frozen_link(climbs: bool) -> None:
    """Velocity and attitude stay within their steps of 0.1 m/s and 1 degree; heights do not."""
    up = np.array([0.0, 0.0, 0.4])
    height_m = [0.04 * k if climbs else 0.4 for k in range(40)]
    track = TelemetryTrack("world", 0.35)
    track.add([TelemetrySample(0.1 * k, up, np.zeros(3), baro_m=100.0 + z) for k, z in enumerate(height_m)])
    assert (not track.readings.frozen.any()) == climbs
    assert (not track.warnings()) == climbs
