import math

import numpy as np
import pytest

from edgeslam_torch.estimation.scale.evidence import (
    aged_since,
    displacement_evidence,
    height_evidence,
)
from edgeslam_torch.estimation.sensors.height import floor_segments
from edgeslam_torch.geometry.rotations import matrix_from_rpy

TILT = math.radians(3.0)
SCALE = 2.5
STRAIGHT, DOWN = np.zeros((1000, 3, 3)), np.tile([0.0, 1.0, 0.0], (1000, 1))
"""A camera that does not turn."""


def path(n=80, size_m=0.4):
    """Positions every half second of a swing in three axes [m]."""
    t = 0.5 * np.arange(n + 1)
    return t, size_m * np.stack([np.sin(0.9 * t), np.sin(0.7 * t + 1.0), 0.6 * np.sin(1.1 * t + 2.0)], axis=1)


def moved(rng, n=80, noise_m=0.0094, noise_map_m=0.0, bias=None, R=None):
    t, p = path(n)
    d = np.diff(p, axis=0)
    seen = np.diff(p + noise_map_m * rng.standard_normal(p.shape), axis=0) / SCALE
    told = d + noise_m * rng.standard_normal(d.shape) + (0.0 if bias is None else 0.5 * bias)
    return t[:-1], seen if R is None else seen @ R, told


def displaced(t, seen, told, sigma_map_m=1e-4, sigma_m=0.0094):
    n = len(t)
    sigma_map = np.full(n, sigma_map_m / SCALE)
    return displacement_evidence(seen, told, t, np.full(n, 0.5), sigma_map, np.full(n, sigma_m), STRAIGHT[:n], TILT)


def flown(rng, n=300, noise_m=0.012, tilt=(0.0, 0.0), step=None):
    """Heights at 10 Hz above a floor that may have furniture on it, and a map that may be tilted."""
    t = 0.1 * np.arange(n)
    p = 0.5 * np.stack([np.sin(0.3 * t), np.cos(0.4 * t), 0.5 * np.sin(0.5 * t)], axis=1)
    z = p[:, 2] + 1.0 + noise_m * rng.standard_normal(n)
    if step is not None:
        z[step] -= 0.4
    return t, p @ matrix_from_rpy(np.array([*tilt, 0.0])).T / SCALE, z


def heights(t, p, z):
    segment = floor_segments(t, z, SCALE * p[:, 2], 0.08)
    return height_evidence(p, DOWN[: len(t)], z, t, segment, 1e-4, 0.015, SCALE, TILT)


def errors(draw, count):
    """Log error of the scale and its ratio to the stated sigma, over draws."""
    out = []
    for _ in range(count):
        s, sigma = draw()[0].solved(TILT)
        out.append((math.log(s / SCALE), math.log(s / SCALE) / sigma))
    return np.array(out).T


def test_stated_sigma_is_that_of_the_errors(rng):
    _, ratio = errors(lambda: [displaced(*moved(rng))], 60)
    assert 0.6 < np.std(ratio) < 1.4  # 60 draws: one sigma of the standard deviation is 0.09
    assert abs(np.mean(ratio)) < 0.5


def test_parts_of_a_flight_that_differ_in_scale_widen_sigma(rng):
    """A map that has grown by a third while it was made: the mean is no surer than its parts are alike."""
    growing = np.repeat([0.85, 0.95, 1.05, 1.15], 20)[:, None]

    def drifting():
        t, seen, told = moved(rng)
        return [displaced(t, seen * growing, told)]

    error, ratio = errors(drifting, 20)
    _, steady = displaced(*moved(rng)).solved(TILT)
    _, sigma = drifting()[0].solved(TILT)
    assert sigma > 4 * steady
    assert 0.04 < sigma < 0.12
    assert np.abs(error).max() < 0.06
    assert np.abs(ratio).max() < 1.0


def test_a_map_that_drifts_does_not_shrink_the_scale(rng):
    """Unmodelled, correlated pose errors of 25 mm lengthen the visual path by 2 %."""

    def drifting():
        t, p = path(120, 0.25)
        walk = np.zeros_like(p)
        for k in range(1, len(p)):
            walk[k] = 0.88 * walk[k - 1] + math.sqrt(1 - 0.88**2) * 0.025 * rng.standard_normal(3)
        t, p, seen = t[::2], p[::2], (p + walk)[::2]
        told = np.diff(p, axis=0) + 0.0094 * rng.standard_normal((len(p) - 1, 3))
        n = len(told)
        sigma_map, sigma_m = np.full(n, 1e-4), np.full(n, 0.0094)
        return [
            displacement_evidence(
                np.diff(seen, axis=0) / SCALE, told, t[:-1], np.ones(n), sigma_map, sigma_m, STRAIGHT[:n], TILT
            )
        ]

    error, ratio = errors(drifting, 40)
    assert abs(np.mean(error)) < 0.008
    assert np.sqrt(np.mean(ratio**2)) < 1.5


def test_a_velocity_bias_that_walks_does_not_pull_the_scale(rng):
    def biased():
        walk = 0.03 * rng.standard_normal(3) + 0.01 * np.cumsum(rng.standard_normal((80, 3)), axis=0) * math.sqrt(0.5)
        return [displaced(*moved(rng, bias=walk))]

    error, ratio = errors(biased, 30)
    assert np.sqrt(np.mean(error**2)) < 0.03
    assert np.sqrt(np.mean(ratio**2)) < 1.6


def test_too_little_says_nothing(rng):
    t, seen, told = moved(rng)
    assert displaced(t[:5], seen[:5], told[:5]) is None
    assert displaced(t, 0.0 * seen, told) is None
    t, p, z = flown(rng)
    assert heights(t[:8], p[:8], z[:8]) is None


def test_height_gives_the_scale_of_a_tilted_map(rng):
    """One degree of tilt over half a metre is a centimetre of height: left out, 4 % of this motion."""
    error, ratio = errors(lambda: [heights(*flown(rng, tilt=(0.02, -0.02)))], 20)
    assert np.sqrt(np.mean(error**2)) < 0.015
    assert np.sqrt(np.mean(ratio**2)) < 1.6


# -- a map that drifts in scale ------------------------------------------------------------------------------------


def test_a_noisy_map_does_not_shrink_the_scale_from_height(rng):
    """A climb of 12 cm to and fro, seen with 5 cm of noise: as a regressor it would shrink the scale by 8 %."""

    def noisy():
        t, p, z = flown(rng, 600)
        p[:, 2] *= 0.5
        z = 1.0 + SCALE * p[:, 2] + 0.012 * rng.standard_normal(len(z))
        seen = p + 0.05 / SCALE * rng.standard_normal(p.shape)
        segment = np.zeros(len(t), dtype=np.int64)
        return [height_evidence(seen, DOWN[: len(t)], z, t, segment, 0.05 / SCALE, 0.015, SCALE, TILT)]

    error, _ = errors(noisy, 40)
    assert abs(np.mean(error)) < 0.03


def climbed_then_level(rng, drift):
    """Climb for two seconds, then level flight for ten; the map's first two seconds are ``drift`` shorter."""
    t = 0.5 * np.arange(25)
    step = np.where(t[:, None] < 2.0, [0.0, 0.0, 0.25], [0.2, 0.05, 0.0]) + 0.03 * rng.standard_normal((25, 3))
    seen = step * np.where(t < 2.0, math.exp(-drift), 1.0)[:, None] / SCALE
    told = step + 0.0094 * rng.standard_normal(step.shape)
    return t, seen, told


def climbed(rng, drift):
    """Heights of the same flight at 10 Hz."""
    t = 0.1 * np.arange(120)
    z = 0.5 * np.minimum(t, 2.0)
    p = np.stack([0.4 * np.maximum(t - 2.0, 0.0), 0.0 * t, z * math.exp(-drift)], axis=1) / SCALE
    return t, p, z + 0.012 * rng.standard_normal(120)


def test_the_present_scale_follows_a_map_that_has_drifted_since_the_climb(rng):
    """By 15 %: one scale for all lies between the two; the present one is right within its sigma."""
    present, throughout = [], []
    for _ in range(12):
        t, seen, told = climbed_then_level(rng, 0.15)
        given = (seen, told, t, np.full(25, 0.5), np.full(25, 1e-3 / SCALE), np.full(25, 0.0094), STRAIGHT[:25], TILT)
        for found, aged in ((present, aged_since(t + 0.5, 0.0, 12.5)), (throughout, None)):
            s, sigma = displacement_evidence(*given, aged).solved(TILT)
            found.append((math.log(s / SCALE), sigma))
    now, all_along = np.array(present), np.array(throughout)
    assert abs(now[:, 0].mean()) < 0.7 * all_along[:, 0].mean()
    assert np.sqrt(np.mean((now[:, 0] / now[:, 1]) ** 2)) < 1.5


def test_heights_of_an_old_climb_are_less_sure_of_the_present_scale(rng):
    """A climb ten seconds ago of a map that is 10 % off there: covered, the surer the younger the climb."""
    t, p, z = climbed(rng, 0.1)
    segment = np.zeros(len(t), int)
    sigmas = []
    for until, aged in ((40, True), (120, True), (120, False)):
        given = (p[:until], DOWN[:until], z[:until], t[:until], segment[:until], 1e-4, 0.015, SCALE, TILT)
        s, sigma = height_evidence(*given, aged_since(t[:until], 0.0, t[until - 1]) if aged else None).solved(TILT)
        sigmas.append(sigma)
        assert s == pytest.approx(SCALE * math.exp(0.1), rel=0.03)
    assert sigmas[0] < 0.8 * sigmas[1]
    assert sigmas[2] < 0.8 * sigmas[1]
