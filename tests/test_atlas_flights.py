"""Two flights: the second begins in the map that the first has saved."""

from functools import lru_cache

import numpy as np
import pytest
from point_map import check_map
from rendered import CAMERA, film, panels, sideways, stairs_world

from edgeslam_torch.atlas.atlas_file import read_atlas, write_atlas
from edgeslam_torch.atlas.prior_map import FOUND
from edgeslam_torch.cli import main
from edgeslam_torch.config import DepthConfig, SlamConfig
from edgeslam_torch.eval.metrics.align import umeyama
from edgeslam_torch.slam import EdgeSlam

NO_NETWORK = SlamConfig(depth=DepthConfig(weights="none"))


@lru_cache(maxsize=1)
def second_film():
    """The other way, from the middle of the first path, 5 cm lower and nearer."""
    poses = sideways(40, 0.03, turn_rad=0.004)[30:8:-1].copy()
    poses[:, :3, 3] += [0.0, 0.05, 0.05]
    return film(stairs_world(), CAMERA, poses, step_s=1 / 30)


@lru_cache(maxsize=1)
def elsewhere():
    return film(stairs_world(9), CAMERA, sideways(30, 0.03, turn_rad=0.004), step_s=1 / 30)


@lru_cache(maxsize=1)
def first_flight():
    slam = EdgeSlam(CAMERA, NO_NETWORK, depth=panels().depth_function())
    for frame in panels().frames:
        slam.step(frame)
    slam.finish()
    return slam, slam.saved_atlas("first")


def second_flight(frames, depth=None, atlas=None):
    slam = EdgeSlam(CAMERA, NO_NETWORK, depth=depth)
    slam.load_atlas(first_flight()[1] if atlas is None else atlas)
    outputs = [slam.step(frame) for frame in frames]
    check_map(slam.map)
    slam.finish()
    check_map(slam.map)
    return slam, outputs


def similarity(T_w_c, truth):
    return umeyama(T_w_c[:, :3, 3], truth[:, :3, 3], "sim3")


@pytest.mark.slow
def test_second_flight_is_in_the_map_of_the_first_at_once_and_in_its_metres(tmp_path):
    write_atlas(tmp_path / "room.atlas", first_flight()[1])
    slam, outputs = second_flight(second_film().frames, atlas=read_atlas(tmp_path / "room.atlas"))
    said = [o.index for o in outputs if FOUND in o.reason]
    assert len(said) == 1 and said[0] <= 6, "said once, 0.2 s after take-off"
    assert all(o.piece == 0 and o.status.supported for o in outputs[said[0] :])
    assert slam.support().supported.all() and set(slam.support().piece) == {0}, "frames before it are placed later"
    _, first = first_flight()[0].trajectory()
    _, second = slam.trajectory()
    known = similarity(first, panels().T_w_c)
    error = known.points(second[:, :3, 3]) - second_film().T_w_c[:, :3, 3]
    assert np.sqrt((error**2).sum(1).mean()) < 0.02  # metres, 2.5 m from the panels; 0.013 when written
    summary = slam.earlier_flights()
    assert summary["flights"] == ["first"] and summary["frames_placed"] == len(outputs)
    assert summary["found_after_s"] == pytest.approx(said[0] / 30)
    assert slam.scale.source == "atlas" and slam.scale.value == 1.0
    assert outputs[-1].metric


@pytest.mark.slow
def test_a_flight_elsewhere_has_a_map_of_its_own_and_both_are_saved():
    slam, outputs = second_flight(elsewhere().frames)
    assert {o.piece for o in outputs} == {1}
    assert slam.earlier_flights()["found_after_s"] is None
    assert any("no place of the atlas was recognised" in warning for warning in slam.warnings())
    saved = slam.saved_atlas("elsewhere")
    assert len(saved.scale) == 2
    assert saved.scale[0] == first_flight()[1].scale[0], "its metres are not forgotten"
    assert (saved.arrays["keyframe.piece"] == 0).sum() == first_flight()[1].keyframes


# -- the command -------------------------------------------------------------------------------------------------


@pytest.fixture
def recording(tmp_path, write_tum):
    return write_tum(tmp_path / "recording", 3)


@pytest.mark.slow
def test_command_saves_and_reports(tmp_path, write_images, capsys):
    for name, shot in (("monday", panels()), ("tuesday", second_film())):
        shot.write(tmp_path / name)
    atlas = str(tmp_path / "room.atlas")
    options = ["--depth", "none", "--no-report", "--out"]
    assert main(["run", str(tmp_path / "monday"), *options, str(tmp_path / "m"), "--save-atlas", atlas]) == 0
    assert "atlas saved: " in capsys.readouterr().out
    assert main(["run", str(tmp_path / "tuesday"), *options, str(tmp_path / "t"), "--atlas", atlas]) == 0
    said = capsys.readouterr().out
    assert "atlas: recognised 0." in said and "22 of 22 frames lie in it" in said
    assert FOUND in (tmp_path / "t" / "status.csv").read_text()
    assert '"found_after_s": 0.' in (tmp_path / "t" / "summary.json").read_text()


@pytest.mark.parametrize(
    "options",
    [["--atlas", "none.atlas"], ["--atlas", "text"], ["--save-atlas", "text"], ["--save-atlas", "nowhere/room.atlas"]],
)
def test_command_refuses_in_one_line_before_it_flies(tmp_path, recording, monkeypatch, capsys, options):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "text").write_text("notes")
    assert main(["run", str(recording), "--out", str(tmp_path / "out"), *options]) == 1
    assert options[1] in capsys.readouterr().err.strip().splitlines()[-1]
    assert not (tmp_path / "out").exists()
    assert (tmp_path / "text").read_text() == "notes"
