"""What holds for every layout."""

from pathlib import Path

import pytest

from edgeslam_torch.eval.inputs.dataset import open_dataset
from edgeslam_torch.readers.layouts import layout_of, layouts
from edgeslam_torch.readers.source import open_source


@pytest.mark.parametrize("layout", layouts(), ids=lambda layout: layout.KIND)
def test_folder_of_something_else_is_not_recognised(layout, tmp_path):
    (tmp_path / "notes.txt").write_text("")
    assert not layout.recognises(tmp_path)
    assert layout_of(tmp_path) is None


def test_every_layout_has_a_name_of_its_own():
    kinds = [layout.KIND for layout in layouts()]
    assert len(set(kinds)) == len(kinds) >= 4


@pytest.mark.parametrize(
    ("name", "fx"), [("rgbd_dataset_freiburg1_desk", 517.306408), ("tum_fr2_desk", 520.908620), ("fr12_desk", None)]
)
def test_evaluation_and_slam_take_the_same_camera(tmp_path: Path, write_tum, name, fx):
    folder = write_tum(tmp_path / name, 2, (640, 480))
    (folder / "groundtruth.txt").write_text("100.0 0 0 0 0 0 0 1\n100.1 1 0 0 0 0 0 1\n")
    camera = open_dataset(folder).camera
    assert (None if camera is None else camera.fx) == fx
    assert open_source(folder).camera.fx == (fx or 1.2 * 640)
