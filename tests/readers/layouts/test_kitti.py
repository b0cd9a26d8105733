"""KITTI odometry sequences for SLAM and evaluation: the same images, clock, camera and truth."""

import numpy as np
import pytest

from edgeslam_torch.errors import CalibrationError, SourceError
from edgeslam_torch.eval.inputs.dataset import open_dataset
from edgeslam_torch.readers.source import open_source

CALIB = "P0: 700 0 31.5 0 0 701 23.5 0 0 0 1 0\nP2: 710 0 30.5 44.8 0 711 22.5 0.2 0 0 1 0.003\n"


@pytest.fixture
def sequence(tmp_path, write_images):
    """Sequence 07 of four images, one of them missing, with truth."""
    folder = tmp_path / "sequences" / "07"
    write_images(folder / "image_2", [f"{i:06d}.png" for i in (0, 1, 3)])
    (folder / "times.txt").write_text("".join(f"{0.1 * i:e}\n" for i in range(4)))
    (folder / "calib.txt").write_text(CALIB)
    (tmp_path / "poses").mkdir()
    T = np.tile(np.eye(4)[:3], (4, 1, 1))
    T[:, 2, 3] = [0.0, 1.0, 2.0, 3.0]
    np.savetxt(tmp_path / "poses" / "07.txt", T.reshape(4, 12))
    return folder


def test_images_have_the_stamps_of_their_lines(sequence):
    source = open_source(sequence)
    assert (source.kind, source.problems) == ("kitti", [])
    assert [f.stamp_s for f in source.frames()] == pytest.approx([0.0, 0.1, 0.3])
    assert source.groundtruth == sequence.parent.parent / "poses" / "07.txt"


def test_colour_camera_goes_before_the_grey_one_each_with_its_own_matrix(sequence, write_images):
    assert (open_source(sequence).camera.fx, open_source(sequence).camera.cy) == (710.0, 22.5)
    (sequence / "image_2").rename(sequence / "image_0")
    assert (open_source(sequence).camera.fx, open_source(sequence).camera.cy) == (700.0, 23.5)


def test_bad_files_are_named(sequence):
    (sequence / "calib.txt").write_text("P2: 1 2 x\n")
    with pytest.raises(CalibrationError, match=r"calib\.txt: no line 'P2:'"):
        open_source(sequence)
    (sequence / "times.txt").write_text("0.0\nlater\n")
    with pytest.raises(SourceError, match=r"times\.txt: line 2"):
        open_source(sequence)


def test_image_without_a_stamp_is_left_out_by_name(sequence, write_images):
    write_images(sequence / "image_2", ["000004.png", "cover.png"])
    assert [p.reason for p in open_source(sequence).problems] == ["its name is not a line of times.txt"] * 2


def test_evaluation_reads_the_same_clock(sequence):
    dataset = open_dataset(sequence)
    np.testing.assert_allclose(dataset.truth.stamps_s, [0.0, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(dataset.truth.positions[:, 2], [0.0, 1.0, 2.0, 3.0])
    np.testing.assert_allclose(dataset.frame_stamps_s, [0.0, 0.1, 0.3])
    assert dataset.truth.stamped and dataset.camera is not None and dataset.camera.fy == 711.0
