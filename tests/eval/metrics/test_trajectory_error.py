"""Trajectory errors: worked by hand, against evo, and for common mistakes in input files."""

import re
from dataclasses import replace

import numpy as np
import pytest
from markdown_rows import rows
from scipy.spatial.transform import Rotation

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.associate import associate, match, on_one_clock
from edgeslam_torch.eval.inputs.trajectory_files import Trajectory, read_trajectory
from edgeslam_torch.eval.metrics.align import AlignmentKind, umeyama
from edgeslam_torch.eval.metrics.diagnose import explain
from edgeslam_torch.eval.metrics.trajectory_error import score_common, score_trajectory
from edgeslam_torch.eval.report.tables import common_report
from edgeslam_torch.geometry import se3


def random_pair(rng, count=18):
    """A wandering camera and an estimate of it: noisy, turned, shifted, scaled, some poses missing."""
    stamps = 1e9 + np.cumsum(rng.uniform(0.02, 0.05, count))
    R = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.05, (count, 3)), axis=0))
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R.as_matrix(), np.cumsum(rng.normal(0, 0.08, (count, 3)), axis=0)
    E = T.copy()
    E[:, :3, :3] = (Rotation.from_rotvec(rng.normal(0, 0.02, (count, 3))) * R).as_matrix()
    E[:, :3, 3] += rng.normal(0, 0.02, (count, 3))
    G = se3.exp(rng.normal(0, 1.0, 6))
    E = G @ E
    E[:, :3, 3] *= rng.uniform(0.3, 3.0)
    keep = np.sort(rng.choice(count, rng.integers(10, count), replace=False))
    jitter = rng.uniform(-0.004, 0.004, len(keep))
    return Trajectory(stamps, T, "truth"), Trajectory(stamps[keep] + jitter, E[keep], "estimate")


def test_umeyama_recovers_what_was_applied(rng):
    p = rng.normal(size=(30, 3))
    R, t = Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix(), np.array([1.0, 2.0, -3.0])
    found = umeyama(p, 2.5 * p @ R.T + t)
    assert found.scale == pytest.approx(2.5, abs=1e-12)
    np.testing.assert_allclose(found.R, R, atol=1e-12)
    np.testing.assert_allclose(found.t, t, atol=1e-12)
    assert np.linalg.det(umeyama(p, p * [1.0, 1.0, -1.0]).R) == pytest.approx(1.0), "never a mirror"


def test_error_worked_out_by_hand():
    T = np.tile(np.eye(4), (3, 1, 1))
    T[:, 0, 3] = [0.0, 1.0, 2.0]
    E = T.copy()
    E[:, 1, 3] = [0.3, 0.0, -0.3]
    stamps = np.arange(3.0)
    score = score_trajectory(Trajectory(stamps, T), Trajectory(stamps, E), "none")
    assert score.ate_m.rmse == pytest.approx(np.sqrt(0.18 / 3))
    assert score.full_transform.rmse == pytest.approx(np.sqrt(0.18 / 3))
    assert score.rotation_deg.max == 0.0
    found = [(relative.pairs, relative.translation_m.rmse) for relative in score.relative]
    assert found == [(2, pytest.approx(0.3))] * 3, "a frame, a second and a metre are one step here"
    assert score.truth_path_m == 2.0
    quarter = E.copy()
    quarter[:, :3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    turned = score_trajectory(Trajectory(stamps, T), Trajectory(stamps, quarter), "none")
    assert turned.rotation_deg.rmse == pytest.approx(90.0)
    # ||R - I||_F of 90 degrees is 2, its square 4, and the translation's 0.06 on the mean.
    assert turned.full_transform.rmse == pytest.approx(np.sqrt(4.0 + 0.06))


def evo_figures(truth, estimate, kind):
    """What evo finds for the same pair."""
    sync = pytest.importorskip("evo.core.sync", reason="evo is not installed: no outside oracle")
    from evo.core import metrics
    from evo.core.trajectory import PoseTrajectory3D

    a, b = (PoseTrajectory3D(poses_se3=list(t.T_w_c), timestamps=t.stamps_s) for t in (truth, estimate))
    a, b = sync.associate_trajectories(a, b, max_diff=0.02)
    if kind is not AlignmentKind.NONE:
        b.align(a, correct_scale=kind is AlignmentKind.SIM3)
    out = {"pairs": a.num_poses}
    relations = metrics.PoseRelation
    for name, relation in (
        ("translation", relations.translation_part),
        ("rotation", relations.rotation_angle_deg),
        ("full", relations.full_transformation),
    ):
        ape = metrics.APE(relation)
        ape.process_data((a, b))
        out[name] = ape.get_statistic(metrics.StatisticsType.rmse)
        out[name + " max"] = ape.get_statistic(metrics.StatisticsType.max)
    for unit, all_pairs in ((metrics.Unit.frames, True), (metrics.Unit.meters, True)):
        for name, relation in (("rpe", relations.translation_part), ("rpe angle", relations.rotation_angle_deg)):
            rpe = metrics.RPE(relation, 1.0, unit, rel_delta_tol=0.1, all_pairs=all_pairs, pairs_from_reference=True)
            try:
                rpe.process_data((a, b))
            except metrics.filters.FilterException:
                continue
            out[f"{name} {unit.value}"] = rpe.get_statistic(metrics.StatisticsType.rmse)
    return out


def our_figures(truth, estimate, kind):
    score = score_trajectory(truth, estimate, kind)
    out = {"pairs": score.matched}
    for name, stats in (("translation", score.ate_m), ("rotation", score.rotation_deg), ("full", score.full_transform)):
        out[name], out[name + " max"] = stats.rmse, stats.max
    for relative, unit in ((score.relative[0], "frames"), (score.relative[2], "m")):
        out[f"rpe {unit}"], out[f"rpe angle {unit}"] = relative.translation_m.rmse, relative.rotation_deg.rmse
    return out


def assert_agrees(truth, estimate, kind):
    theirs, ours = evo_figures(truth, estimate, kind), our_figures(truth, estimate, kind)
    for name, value in theirs.items():
        assert ours[name] == pytest.approx(value, abs=1e-6, rel=1e-9), name


@pytest.mark.parametrize("kind", list(AlignmentKind))
def test_agrees_with_evo_on_random_trajectories(kind, rng):
    for _ in range(25):
        assert_agrees(*random_pair(rng), kind)


REFERENCES = {  # rmse, mean, std, max, pairs: evo 1.38, Sim(3), max dt 0.02 s (shared recordings' README)
    "freiburg1_xyz-rgbdslam_drift.txt": ("tum_fr1_xyz/groundtruth.txt", 0.013394, 0.011993, 0.005964, 0.034810, 786),
    "fr2_desk_ORB.txt": (
        "reference_trajectories/fr2_desk_groundtruth.txt",
        0.006187,
        0.005642,
        0.002539,
        0.021576,
        2225,
    ),
}


@pytest.mark.data
@pytest.mark.parametrize("name", sorted(REFERENCES))
def test_reference_trajectories_score_what_evo_prints(name, data_dir):
    truth_name, rmse, mean, std, most, pairs = REFERENCES[name]
    truth = read_trajectory(data_dir / truth_name)
    estimate = read_trajectory(data_dir / "reference_trajectories" / name)
    score = score_trajectory(truth, estimate)
    assert score.matched == pairs
    found = (score.ate_m.rmse, score.ate_m.mean, score.ate_m.std, score.ate_m.max)
    assert found == pytest.approx((rmse, mean, std, most), abs=1e-6)
    near = (truth.stamps_s > estimate.stamps_s[200]) & (truth.stamps_s < estimate.stamps_s[500])
    assert_agrees(truth.take(near), estimate.take(slice(200, 500)), AlignmentKind.SIM3)  # evo is slow


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")])
@pytest.mark.parametrize("begin", [0.0, 1.6e9])
@pytest.mark.parametrize("whose", ["truth", "estimate"])
def test_stamps_in_other_units_are_converted_and_said(factor, unit, begin, whose, loop, rng):
    stamps = begin + np.arange(len(loop)) * 0.05
    files = {"truth": replace(loop, stamps_s=stamps), "estimate": replace(noisy(loop, rng), stamps_s=stamps + 0.003)}
    files[whose] = replace(files[whose], stamps_s=files[whose].stamps_s * factor, source="mine.txt")
    score = score_trajectory(files["truth"], files["estimate"])
    assert score.matched == len(stamps) and score.ate_m.rmse < 0.01
    np.testing.assert_allclose(score.stamps_s, stamps, atol=1e-3)
    said = explain(files["truth"], files["estimate"], score)
    assert len(said) == 1 and "mine.txt" in said[0] and unit in said[0]


@pytest.mark.parametrize("begin", [0.0, 1.3e9])
@pytest.mark.parametrize("poses", [[30.0], [30.0, 30.03, 30.07]])
def test_a_handful_of_poses_are_seconds_too(begin, poses):
    stamps = begin + np.arange(0.0, 60.0, 0.01)
    truth, few = (Trajectory(t, np.tile(np.eye(4), (len(t), 1, 1))) for t in (stamps, begin + np.array(poses)))
    truth, few = on_one_clock(truth, few)
    assert truth.notes == few.notes == ()
    assert len(associate(truth.stamps_s, few.stamps_s)[0]) == len(poses)


@pytest.mark.parametrize(
    ("shift", "words"),
    [(-1.5e9, "counts from 1970"), (300.0, "constant offset"), (4e6, "days apart"), (0.05, "--max-dt")],
)
def test_stamps_that_never_meet_are_explained(shift, words):
    truth = 1.5e9 + np.arange(0.0, 20.0, 0.1)
    with pytest.raises(EvaluationError, match=words):
        associate(truth, truth + shift)


def findings(truth, estimate, kind="sim3", **options):
    score = score_trajectory(truth, estimate, kind, **options)
    return " | ".join(explain(truth, estimate, score))


def noisy(loop, rng):
    return at(loop, loop.positions + rng.normal(0.0, 0.004, (len(loop), 3)))


WORLD = se3.exp(np.array([4.0, -2.0, 1.0, 0.4, -0.9, 1.3]))
"""Another world frame: a run's begins where the camera was first."""


def w_first(trajectory):
    """Its file, with the scalar part written first and read as if it came last."""
    q = Rotation.from_matrix(trajectory.T_w_c[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    return turned(trajectory, Rotation.from_quat(q).as_matrix())


def turned(trajectory, R):
    T = trajectory.T_w_c.copy()
    T[:, :3, :3] = R
    return replace(trajectory, T_w_c=T)


def at(trajectory, positions):
    T = trajectory.T_w_c.copy()
    T[:, :3, 3] = positions
    return replace(trajectory, T_w_c=T)


MISTAKES = {
    "world-to-camera": lambda t: replace(t, T_w_c=se3.inverse(t.T_w_c)),
    "qw qx qy qz": w_first,
    "look inverted": lambda t: turned(t, np.swapaxes(t.T_w_c[:, :3, :3], 1, 2)),
    "centimetres": lambda t: at(t, 100.0 * t.positions),
}


@pytest.mark.parametrize("whose", ["the ground truth", "the estimate"])
@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_found_in_the_file_that_has_it(mistake, whose, loop, rng):
    files = {"the ground truth": loop, "the estimate": replace(noisy(loop, rng), T_w_c=WORLD @ noisy(loop, rng).T_w_c)}
    files[whose] = MISTAKES[mistake](files[whose])
    said = findings(*files.values())
    assert mistake in said and said.startswith(whose), said


@pytest.mark.parametrize("mistake", ["world-to-camera", "look inverted"])
def test_nobody_is_blamed_where_both_could_be_wrong(mistake, loop, rng):
    """In one world frame the inverse of either explains it."""
    said = findings(MISTAKES[mistake](loop), noisy(loop, rng))
    assert mistake in said and "undecidable" in said


@pytest.mark.parametrize("alone", [True, False], ids=["positions", "0 0 0 1"])
@pytest.mark.parametrize("whose", ["the ground truth", "the estimate"])
def test_figures_that_need_orientations_are_left_out_without(whose, alone, loop, rng):
    files = {"the ground truth": loop, "the estimate": noisy(loop, rng)}
    files[whose] = replace(turned(files[whose], np.eye(3)), oriented=not alone)
    score = score_trajectory(*files.values())
    assert score.ate_m.rmse < 0.01
    assert np.isnan(score.rotation_deg.rmse) and np.isnan(score.full_transform.rmse)
    assert score.relative == () and score.drift == ()
    said = findings(*files.values())
    assert said.startswith(whose) and "left out" in said


def still(trajectory, noise_m):
    jitter = noise_m * np.random.default_rng(0).normal(size=(len(trajectory), 3))
    return at(replace(trajectory, source="gt.txt"), [3.0, 2.0, 1.0] + jitter)


def met_by_accident(trajectory):
    """4 of its 787 poses, which would give an ATE of millimetres."""
    stamps = trajectory.stamps_s[0]
    return replace(trajectory, stamps_s=stamps + 0.0251 + 1.037 * (trajectory.stamps_s - stamps))


@pytest.mark.parametrize(
    ("pair", "words"),
    [
        (lambda t: (still(t, 0.0), t), r"gt.txt: .*never moves"),
        (lambda t: (still(t, 2e-4), t), r"gt.txt: .*never moves"),
        (lambda t: (t, still(t, 0.0)), "never moves: nothing to align"),
        (lambda t: (t, t.take(slice(10, 11))), "at least 2"),
        (lambda t: (t, met_by_accident(t)), r"poses have a match.*--max-dt"),
    ],
)
def test_what_gives_no_meaningful_score_is_refused(pair, words, loop):
    with pytest.raises(EvaluationError, match=words):
        score_trajectory(*pair(loop), max_dt_s=0.001)


def walked(trajectory):
    return np.cumsum(np.random.default_rng(7).normal(0, 0.05, (len(trajectory), 3)), axis=0)


def waves(t):
    return np.stack([np.sin(1.9 * t), np.cos(2.7 * t), 0.3 * np.sin(3.1 * t)], axis=1)


@pytest.mark.parametrize(
    ("change", "said", "unsaid"),
    [
        (lambda t: t, "", " "),
        (lambda t: replace(t, T_w_c=t.T_w_c[::-1]), "backwards", "mirrored"),
        (lambda t: at(t, t.positions[:, [1, 0, 2]]), "mirrored", "world-to-camera"),
        (lambda t: at(t, t.positions * [-1, 1, 1]), "mirrored", "world-to-camera"),
        (lambda t: at(t, 1000.0 * t.positions), "millimetres", "centimetres"),
        (lambda t: turned(t, t.T_w_c[:, :3, :3] @ WORLD[:3, :3]), "different bodies", "inverted"),
        (lambda t: replace(t, stamps_s=t.stamps_s + 0.024 * (np.arange(len(t)) % 5 > 1)), "found a partner", "unit"),
        (lambda t: replace(t, stamps_s=1e3 * (t.stamps_s + 1.37)), "--offset -1.3", "nanoseconds"),
        (lambda t: t.take(np.array([10, 90, 150])), "only 3 poses", "mirrored"),
        (lambda t: at(t, waves(t.stamps_s)), "another sequence", "drifted"),
        (lambda t: at(t, t.positions + walked(t)), "the run drifted or broke", "another sequence"),
    ],
)
def test_a_mistake_is_recognised_for_what_it_is(change, said, unsaid, loop, rng):
    text = findings(loop, change(noisy(loop, rng)))
    assert said in text and unsaid not in text


def test_orientations_that_hardly_turn_are_judged_by_their_angle_to_the_truth(loop, rng):
    """A recording like fr1_xyz looks one way: a wrong order of the quaternion spreads little, but is far off."""
    estimate = noisy(loop, rng).take(slice(0, 20))
    for mistake in ("look inverted", "qw qx qy qz"):
        assert mistake in findings(loop, MISTAKES[mistake](estimate))
    assert "left out" in findings(loop, turned(estimate, np.eye(3)))


@pytest.mark.parametrize("factor", [1.0, 1e3, 1e9], ids=["s", "ms", "ns"])
def test_clocks_that_never_meet_are_brought_together_by_shape(factor, loop, rng):
    truth = replace(loop, stamps_s=loop.stamps_s + 1.5e9, source="truth.txt")
    estimate = noisy(loop, rng).take(slice(40, 160))
    estimate = replace(estimate, stamps_s=factor * (estimate.stamps_s - estimate.stamps_s[0]), source="mine.txt")
    with pytest.raises(EvaluationError, match=r"mine.txt against truth.txt") as caught:
        score_trajectory(truth, estimate)
    found = re.search(r"fit best with --offset ([\d.]+)", str(caught.value))
    assert found is not None and float(found.group(1)) == pytest.approx(truth.stamps_s[40], abs=0.03)
    fitted = score_trajectory(truth, estimate, offset_s=float(found.group(1)), max_dt_s=0.03)
    assert fitted.ate_m.rmse < 0.03


def test_a_line_and_a_monocular_run_judged_without_scale_are_warned_about(loop, rng):
    line = at(loop, np.arange(len(loop))[:, None] * [0.01, 0.0, 0.0])
    assert "along a line" in findings(line, line)
    small = at(loop, 0.4 * noisy(loop, rng).positions)
    assert "without scale" in findings(loop, small, "se3")
    assert "without scale" not in findings(loop, small, "sim3")


@pytest.fixture
def early_mistake(loop, rng):
    """Good, but for its first fifty poses."""
    T = loop.T_w_c.copy()
    T[:, :3, 3] += rng.normal(0.0, 0.003, (len(T), 3))
    T[:50, :3, 3] += rng.normal(0.0, 0.2, (50, 3))
    return replace(loop, T_w_c=T)


def test_frames_that_one_lacks_do_not_count_against_the_other(loop, early_mistake):
    late = loop.take(np.arange(60, 200))
    late.T_w_c[:, :3, 3] *= 0.5  # monocular: of any size
    ours, theirs = score_common(loop, [("ours", early_mistake), ("late", late)])
    assert (ours.frames, theirs.frames) == (200, 140)
    assert ours.sim3.matched == theirs.sim3.matched == 140
    assert ours.sim3.ate_m.rmse < 0.01 and theirs.sim3.ate_m.rmse < 1e-9
    assert theirs.sim3.scale == pytest.approx(2.0)
    assert ["late", "140", "0.0000"] in [row[:3] for row in rows(common_report([ours, theirs], markdown=True))]


def test_keyframes_and_other_clocks_are_compared_too(loop, early_mistake):
    keyframes = loop.take(slice(61, None, 7))
    keyframes = replace(keyframes, stamps_s=1e3 * (keyframes.stamps_s + 0.004))  # milliseconds, 4 ms late
    found = score_common(loop, [("ours", early_mistake), ("keyframes", keyframes)])
    assert [s.sim3.matched for s in found] == [20, 20]
    assert found[0].sim3.ate_m.rmse < 0.01


def test_a_frame_between_two_common_ones_costs_neither(loop):
    """Every frame of a trajectory that begins early, beside every second one with jitter of its stamps."""
    whole = replace(loop, stamps_s=loop.stamps_s + 0.002 * (np.arange(len(loop)) % 3))
    half = whole.take(slice(61, None, 2))
    found = score_common(loop, [("whole", whole.take(slice(0, len(half)))), ("half", half)])
    assert [s.sim3.matched for s in found] == [5, 5]


def test_runs_with_nothing_in_common_are_named(loop):
    with pytest.raises(EvaluationError, match="a, b: 0 frame"):
        score_common(loop, [("a", loop.take(slice(0, 50))), ("b", loop.take(slice(100, 150)))])


def test_each_pose_of_the_shorter_list_gets_its_nearest():
    truth, estimate = np.array([0.0, 0.1, 0.2, 0.3]), np.array([0.11, 0.29, 5.0])
    i, j = match(truth, estimate, 0.02)
    assert i.tolist() == [1, 3] and j.tolist() == [0, 1]
    i, j = match(estimate, truth, 0.02)
    assert i.tolist() == [0, 1] and j.tolist() == [1, 3]


def test_a_camera_that_only_shifts_has_orientations(loop, rng):
    jitter = Rotation.from_rotvec(rng.normal(0.0, 0.003, (len(loop), 3))).as_matrix()
    assert score_trajectory(turned(loop, np.eye(3)), turned(noisy(loop, rng), jitter)).rotation_deg.rmse < 2.0


def test_no_offset_is_offered_for_another_shape(loop):
    with pytest.raises(EvaluationError) as caught:
        score_trajectory(loop, replace(at(loop, walked(loop)), stamps_s=loop.stamps_s + 300.0))
    assert "fit best" not in str(caught.value)
