"""A cell from recording to figures, on a tiny rendered flight."""

import shutil
from dataclasses import asdict, replace

import numpy as np
import pytest
from rendered import CAMERA, film, sideways, stairs_world

from edgeslam_torch.errors import SourceError
from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.dataset import find_recordings, open_dataset
from edgeslam_torch.eval.inputs.trajectory_files import Trajectory, read_trajectory, write_tum
from edgeslam_torch.eval.judge import flights, run_cell
from edgeslam_torch.eval.judge.cells import VARIANTS, Cell, list_cells
from edgeslam_torch.eval.judge.score import Truth, score
from edgeslam_torch.eval.judge.simulated_imu import RECORDED
from edgeslam_torch.synthetic.flights.courses import COURSES, record_course


def bent_way():
    """``(36, 4, 4)`` a bow."""
    way = sideways(36, 0.03)
    way[:, 1, 3] += 0.2 * np.sin(np.linspace(0.0, np.pi, 36))
    return way


def length_m(way):
    return np.linalg.norm(np.diff(way[:, :3, 3], axis=0), axis=1).sum()


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A TUM-layout folder with 36 images, ground truth and every sixth depth map [mm].

    The way is bent: how a map is turned about a straight one rests on millimetres beside it.
    """
    return film(stairs_world(), CAMERA, bent_way()).write(tmp_path_factory.mktemp("data") / "stairs", depth_every=6)


def run(tmp_path, cell, **changes):
    case = {"cell": asdict(cell), "overrides": ["depth.weights=none"], "max_frames": None}
    return run_cell.run_cell(case | {"flights": str(tmp_path / "flights")} | changes, tmp_path)


@pytest.fixture(scope="module")
def judged(recording, tmp_path_factory):
    """The recording's cell after its run: folder and result."""
    folder = tmp_path_factory.mktemp("judged")
    return folder, run(folder, Cell("stairs", 0, str(recording)))


def test_recording_is_run_and_judged(judged):
    figures = judged[1]["figures"]
    assert judged[1]["notes"] == []
    assert figures["frames"] == 36
    assert figures["supported_end"] == 1.0
    assert figures["supported_live"] < 1.0, "the first frames are posed against a guess"
    assert figures["pieces"] == 1 and figures["losses"] == 0
    assert figures["ate_m"] < 0.01 and figures["path_m"] == pytest.approx(length_m(bent_way()), rel=0.02)
    assert figures["ate_percent"] == pytest.approx(100 * figures["ate_m"] / figures["path_m"])
    assert figures["scale"] is None and figures["se3_m"] is None, "nothing told the scale"
    assert figures["map_within_5cm"] > 0.5 and figures["map_within_10cm"] > 0.8, "depth_scale of camera.yaml is heeded"
    assert figures["cpu_ms"] > 0 and figures["memory_mb"] > 0


@pytest.mark.slow
def test_variant_is_judged_against_the_same_truth(recording, tmp_path):
    result = run(tmp_path, Cell("stairs/half_rate", 0, str(recording), "half_rate"))
    assert result["figures"]["frames"] == 18
    assert result["figures"]["path_m"] == pytest.approx(length_m(bent_way()[::2]), rel=0.02)


def test_run_that_never_moves_scores_a_fixed_position(recording, judged, tmp_path):
    shutil.copytree(judged[0] / "run", tmp_path / "run")
    truth = open_dataset(recording).truth
    still = Trajectory(truth.stamps_s, np.tile(np.eye(4), (len(truth), 1, 1)))
    for name in ("trajectory.txt", "trajectory_online.txt"):
        write_tum(still, tmp_path / "run" / name)
    figures, notes = score(tmp_path / "run", Truth(recording))
    spread = np.sqrt(np.sum(np.var(truth.positions, axis=0)))
    assert figures["ate_m"] == figures["online_m"] == figures["still_m"] == pytest.approx(spread)
    assert notes == ["the estimated trajectory never moves: nothing to align"]


def test_a_recordings_own_imu_is_a_cell_of_its_own(recording, tmp_path):
    with_imu = tmp_path / "stairs"
    shutil.copytree(recording, with_imu)
    stamps_s = open_dataset(recording).frame_stamps_s
    t = np.arange(stamps_s[0] - 1.0, stamps_s[-1] + 1.0, 0.01)
    rows = [f"{s:.6f},0,0,0,0,0,9.81" for s in t]
    (with_imu / "imu.csv").write_text("\n".join(["stamp_s,gx,gy,gz,ax,ay,az", *rows]) + "\n")
    for imu, start in (("", 0), (RECORDED, 3)):
        source, _ = run_cell.opened(Cell("stairs", 3, str(with_imu), imu=imu), tmp_path, tmp_path)
        assert (source.imu_readings is not None) == bool(imu)
        assert next(source.frames()).stamp_s == pytest.approx(stamps_s[start], abs=1e-6)


def test_simulated_flight_is_judged_by_its_world(tmp_path, monkeypatch):
    def record(root, course, seed, flight):
        record_course(root / course, COURSES[course], seed, seconds=0.4)
        return root / course

    monkeypatch.setattr(flights, "flight_folder", record)
    source, truth = run_cell.opened(Cell("flight/blank_corridor", 3, course="blank_corridor"), tmp_path, tmp_path)
    assert source.length == len(open_dataset(truth.poses).truth) == 8
    floor = np.array([[0.0, 0.0, -0.25]])
    assert truth.surfaces(floor) == pytest.approx([0.25], abs=0.01), "the floor is at height 0"


def test_map_of_a_simulation_is_judged_by_its_surfaces(recording, judged):
    figures, _ = score(judged[0] / "run", Truth(recording, surfaces=stairs_world().distance_to_surface))
    assert figures["map_judged"] == 1.0 and 0.0 < figures["map_median_m"] < 0.05 and figures["map_within_10cm"] > 0.8


def test_nothing_to_see_claims_no_map(tmp_path):
    result = run(tmp_path, Cell("none/black", 0, nothing="black"), max_frames=5)
    figures = result["figures"]
    assert figures["supported_end"] == 0 and figures["map_points"] == 0 and figures["metric"] == 0
    assert "ate_m" not in figures


def test_kidnapped_recording_gets_the_truth_of_the_frames_played(recording, tmp_path, monkeypatch):
    monkeypatch.setitem(run_cell.CASES, "kidnap", {"stairs": [[0, 10], [20, 30], [5, 10]]})
    source, truth = run_cell.opened(Cell("stairs/kidnap", 0, str(recording), "kidnap"), tmp_path, tmp_path)
    played, poses = list(source.frames()), read_trajectory(truth.poses)
    original = open_dataset(recording)
    picked = [*range(10), *range(20, 30), *range(5, 10)]
    assert np.allclose(poses.positions, original.truth.positions[picked], atol=1e-6)
    assert np.allclose([f.stamp_s for f in played], poses.stamps_s)
    for frame, number in zip(played, picked, strict=True):
        assert frame.path == original.image_paths[number]


def test_recording_played_backwards_gets_the_truth_of_each_image_also_where_the_last_have_none(recording, tmp_path):
    place = tmp_path / "stairs"
    shutil.copytree(recording, place)
    truth_file = place / "groundtruth.txt"
    truth_file.write_text("".join(truth_file.read_text().splitlines(keepends=True)[:-4]))
    source, truth = run_cell.opened(Cell("stairs/backwards", 0, str(place), "backwards"), tmp_path, tmp_path)
    played, poses = list(source.frames()), read_trajectory(truth.poses)
    assert [f.path.name for f in played] == sorted((p.name for p in (place / "rgb").iterdir()), reverse=True)
    assert np.diff([f.stamp_s for f in played]) == pytest.approx(0.1)
    original = open_dataset(recording)
    shown = {path.name: p for path, p in zip(original.image_paths, original.truth.positions, strict=True)}
    told = {round(stamp, 4): p for stamp, p in zip(poses.stamps_s, poses.positions, strict=True)}
    known = [f for f in played if round(f.stamp_s, 4) in told]
    assert len(known) == len(told) == len(played) - 4
    assert np.allclose([told[round(f.stamp_s, 4)] for f in known], [shown[f.path.name] for f in known], atol=1e-6)


@pytest.mark.slow
def test_second_flight_is_in_the_map_of_the_first_and_judged_against_it(recording, tmp_path, monkeypatch):
    monkeypatch.setitem(run_cell.CASES["second_flight"], "stairs", 20)
    result = run(tmp_path, Cell("stairs/second_flight", 0, str(recording), "second_flight"))
    figures = result["figures"]
    assert figures["frames"] == 16
    assert figures["placed_after_s"] < 1.0 and figures["placed"] > 0.9
    assert 0.0 <= figures["metres_off"] < 0.1


@pytest.mark.slow
def test_a_further_flight_has_another_path_through_the_same_world(tmp_path, monkeypatch):
    monkeypatch.setitem(COURSES, "corridor", replace(COURSES["corridor"], seconds=0.2))
    flights.record_once(tmp_path / "again", "corridor", 3, 1)
    world, first, _ = flights.flown(COURSES["corridor"], 3, seconds=0.4)
    again = open_dataset(tmp_path / "again").truth
    assert len(again.stamps_s) == 4
    assert np.linalg.norm(again.positions[0] - first.T_w_c[0, :3, 3]) > 0.1
    assert world.clearance(again.positions[0]) > 0.2, "in free space of that world"


def test_recordings_with_truth_are_found_and_short_variants_left_out(recording):
    for data in (recording.parent, recording):
        ((name, (folder, stamps_s)),) = find_recordings(data).items()
        assert (name, folder, len(stamps_s)) == ("stairs", recording.resolve(), 36)
    assert find_recordings(recording.parent, min_hz=1e3) == {}
    names = {cell.name for cell in list_cells(recording.parent, "all", [0]) if cell.folder}
    assert {"stairs", "stairs/half_size", "stairs/focal_up"} <= names
    assert not names & {"stairs/half_rate", "stairs/from_100"}
    assert VARIANTS["half_rate"].frames_of(36) == 18


def test_cells_are_chosen_by_pattern_and_repeated_by_seed(recording, tmp_path):
    cells = list_cells(recording.parent, "variants", [0, 1], ["*/focal_*"])
    assert [(c.name, c.seed) for c in cells] == [
        ("stairs/focal_up", 0), ("stairs/focal_up", 1), ("stairs/focal_down", 0), ("stairs/focal_down", 1)
    ]  # fmt: skip
    assert {c.base for c in cells} == {"stairs"}
    with pytest.raises(EvaluationError, match="no cell matches; there are: .*stairs/half_size"):
        list_cells(recording.parent, "variants", [0], ["nothing"])
    with pytest.raises(EvaluationError, match="no such folder of recordings"):
        list_cells(tmp_path / "gone", "base", [0])
    with pytest.raises(SourceError, match="no such file or folder"):
        run(tmp_path, Cell("gone", 0, str(tmp_path / "gone")))


def test_a_cut_shows_one_world_and_then_the_next(recording, tmp_path, monkeypatch):
    asked = []

    def folder(root, course, seed):
        asked.append((course, seed))
        return shutil.copytree(recording, root / f"{seed}", dirs_exist_ok=True)

    monkeypatch.setattr(flights, "flight_folder", folder)
    monkeypatch.setattr(run_cell, "CUT_FRAMES", 4)
    source, truth = run_cell.opened(
        Cell("flight/corridor/cut", 6, variant="cut", course="corridor"), tmp_path, tmp_path
    )
    frames = list(source.frames())
    assert asked == [("corridor", 6), ("corridor", 7)]
    assert [f.path.parent.parent.name for f in frames] == ["6"] * 4 + ["7"] * 4
    assert [f.index for f in frames] == list(range(8))
    assert np.diff([f.stamp_s for f in frames]) == pytest.approx(0.05)
    assert source.telemetry == [] and source.length == 8 and truth.poses is None


@pytest.mark.parametrize("kind", ["noise", "black", pytest.param("frozen", marks=pytest.mark.slow)])
def test_nothing_to_see_is_a_source_like_any_other(kind):
    source = flights.nothing_to_see(kind, 1)
    frames = [next(frames) for frames in [source.frames()] for _ in range(2)]
    same = np.array_equal(frames[0].image, frames[1].image)
    assert same == (kind != "noise")
    assert frames[0].image.any() == (kind != "black")
    assert frames[0].image.shape == (480, 640, 3) and source.length == flights.NONE_FRAMES


@pytest.mark.slow
def test_a_further_flight_through_the_building_takes_off_from_the_same_place(tmp_path, monkeypatch):
    monkeypatch.setitem(COURSES, "building", replace(COURSES["building"], seconds=6.0, rate_hz=2.0))
    flights.record_once(tmp_path / "again", "building", 0, 1)
    first = flights.flown(COURSES["building"], 0)[1].T_w_c[:, :3, 3]
    apart = np.linalg.norm(open_dataset(tmp_path / "again").truth.positions - first, axis=1)
    assert apart[0] < 0.05 and apart.max() > 0.1
