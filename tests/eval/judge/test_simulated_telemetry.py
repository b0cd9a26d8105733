"""Telemetry made along a recording, and the scale that a run states while flying."""

import math

import numpy as np
import pytest

from edgeslam_torch.eval.inputs.run_folder import RunFolder
from edgeslam_torch.eval.inputs.trajectory_files import Trajectory
from edgeslam_torch.eval.judge.simulated_telemetry import KINDS, OFF_S, OUTAGE_S, Drawn
from edgeslam_torch.eval.metrics.run_figures import live_figures
from edgeslam_torch.geometry.mount import camera_on_body

SECONDS = 24.0


@pytest.fixture(scope="module")
def drawn():
    """A camera that swings about with a turned body."""
    t = np.arange(0.0, SECONDS, 0.05)
    T = np.tile(camera_on_body(), (len(t), 1, 1))
    yaw = 0.8
    turn = np.array([[math.cos(yaw), -math.sin(yaw), 0.0], [math.sin(yaw), math.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    T[:, :3, :3] = turn @ T[:, :3, :3]
    T[len(t) // 2 :, :3, :3] = turn @ T[len(t) // 2 :, :3, :3]
    T[:, :3, 3] = np.stack([np.sin(0.8 * t), 0.5 * np.sin(1.1 * t), 1.0 + 0.2 * np.sin(0.9 * t)], axis=1)
    return Drawn(Trajectory(t, T), t, 3)


def velocities(samples):
    return np.array([s.velocity_m_s for s in samples])


def test_right_telemetry_is_in_whole_steps_towards_the_nearest_or_towards_zero(drawn):
    near, cut = (velocities(KINDS[kind](drawn)) for kind in ("rounded", "truncated"))
    assert np.allclose(10.0 * near, np.rint(10.0 * near)) and np.allclose(10.0 * cut, np.rint(10.0 * cut))
    lost = np.abs(near) - np.abs(cut)
    assert set(np.round(lost, 6).ravel()) == {0.0, 0.1}, "the same noise, half of the readings a step lower"
    assert 0.3 < np.mean(lost > 0.05) < 0.6


def test_outage_and_frozen_link_last_as_long_as_they_should(drawn):
    start, end = drawn.outage_s
    assert end - start == OUTAGE_S
    off = [s.stamp_s for s in KINDS["off"](drawn)]
    assert np.max(np.diff(off)) == pytest.approx(OUTAGE_S, abs=0.25)
    stuck = [s for s in KINDS["frozen"](drawn) if start <= s.stamp_s < end]
    assert len(stuck) >= 98 and np.ptp(velocities(stuck), axis=0).max() == 0.0


def test_faulty_stamps_are_moved_or_stretched(drawn):
    right, late, early, doubled = (
        np.array([s.stamp_s for s in KINDS[kind](drawn)]) for kind in ("rounded", "late", "early", "doubled")
    )
    assert np.allclose(late - right, OFF_S) and np.allclose(early - right, -OFF_S)
    assert np.allclose(np.diff(doubled), 2.0 * np.diff(right))


def test_velocities_in_other_units_and_axes(drawn):
    right = velocities(KINDS["rounded"](drawn))
    assert np.abs(velocities(KINDS["centimetres"](drawn)) / 10.0 - right).max() < 0.06
    samples = KINDS["body"](drawn)
    yaw = np.array([s.rpy_rad[2] for s in samples])
    assert yaw[-1] - yaw[0] == pytest.approx(0.8, abs=0.1), "the power-on world turns with the first pose"
    body = velocities(samples)
    forth = np.cos(yaw) * body[:, 0] - np.sin(yaw) * body[:, 1]
    assert np.abs(forth - right[:, 0]).max() < 0.16
    assert np.abs(body - right)[-100:].max() > 0.3


def test_what_is_not_of_this_flight_does_not_go_with_it(drawn):
    right = velocities(KINDS["rounded"](drawn))
    for kind in ("random", "other_flight"):
        other = velocities(KINDS[kind](drawn))
        n = min(len(right), len(other))
        assert abs(np.corrcoef(right[:n, 0], other[:n, 0])[0, 1]) < 0.4, kind
        assert other[:, 0].std() > 0.1
    assert np.isnan([s.tof_m for s in KINDS["random"](drawn)]).all()


def run_of(scales, sigmas, revisions, units, published, truth, tmp_path):
    """A run's folder as read back, twenty frames a second."""
    stamps = truth.stamps_s
    rows = tuple(
        {"stamp_s": str(t), "scale": str(s), "scale_sigma": "" if math.isinf(g) else str(g), "revision": str(r)}
        | {"scale_source": "depth" if math.isinf(g) else "telemetry+depth", "unit": str(u)}
        for t, s, g, r, u in zip(stamps, scales, sigmas, revisions, units, strict=True)
    )
    T = truth.T_w_c.copy()
    T[:, :3, 3] = published
    return RunFolder(tmp_path, truth, Trajectory(stamps, T), rows, {})


def test_scale_while_flying_is_compared_with_the_lengths_published_between_revisions(drawn, tmp_path):
    """The map's unit is 0.5 m; after five seconds 0.55 is published, ten seconds later 0.5 is stated."""
    truth = drawn.truth
    t, n = truth.stamps_s, len(truth.stamps_s)
    later = t >= 5.0
    scales = np.where(t < 5.0, 1.0, np.where(t < 15.0, 0.55, 0.5))
    sigmas = np.where(t < 5.0, np.inf, np.where(t < 15.0, 0.01, 0.005))
    published = np.where(later, 0.55, 1.0)[:, None] * truth.positions / 0.5
    run = run_of(scales, sigmas, later.astype(int), np.where(later, 0.55, 1.0), published, truth, tmp_path)
    figures = live_figures(run, truth)
    assert figures["first_scale_s"] == pytest.approx(5.0, abs=0.06)
    assert figures["first_scale_off"] == pytest.approx(math.log(1.1), abs=1e-6)
    assert figures["first_scale_sigmas"] == pytest.approx(math.log(1.1) * 55.0, abs=1e-3)
    assert figures["beyond_3_sigma"] == pytest.approx(2.5 / (SECONDS - 12.5), abs=0.01)
    never = run_of(np.ones(n), np.full(n, np.inf), np.zeros(n, int), np.ones(n), truth.positions / 0.5, truth, tmp_path)
    assert live_figures(never, truth) == {"beyond_3_sigma": 0.0}
    # A guess revised at once: 0.8 m per map unit from the first frame on is no drone's metre.
    revisions, units = 1 + later.astype(int), np.where(later, 0.55, 0.8)
    guessed = run_of(scales, sigmas, revisions, units, units[:, None] * truth.positions / 0.5, truth, tmp_path)
    assert live_figures(guessed, truth) == pytest.approx(figures)


def test_a_revision_just_before_the_end_leaves_the_lengths_of_the_time_before(drawn, tmp_path):
    truth = drawn.truth
    t = truth.stamps_s
    last = t >= SECONDS - 0.5
    scales, sigmas = np.where(last, 0.52, 0.55), np.full(len(t), 0.01)
    published = scales[:, None] * truth.positions / 0.5
    run = run_of(scales, sigmas, 1 + last.astype(int), scales, published, truth, tmp_path)
    figures = live_figures(run, truth)
    assert figures["first_scale_off"] == pytest.approx(math.log(1.1), abs=1e-6)
    assert figures["beyond_3_sigma"] == pytest.approx(1.0 - 0.5 / (SECONDS - 12.5), abs=0.01)
