"""Pictures of keyframes kept beside a run, for programs that need files."""

from types import SimpleNamespace

import cv2
import numpy as np

from edgeslam_torch.eval.report.keyframe_pictures import image_paths
from edgeslam_torch.types import Frame, FrameStatus
from edgeslam_torch.writers.keyframe_images import KeyframeImages, kept_images


def _frame(index):
    image = cv2.GaussianBlur(np.random.default_rng(index).integers(0, 256, (48, 64, 3), np.uint8), (0, 0), 3)
    return Frame(index, 100.0 + index, image)


def _played(folder, frames, keyframes, starting=(), became=()):
    """Frames of which some are keyframes, and some are while a map is sought; of these, some become keyframes."""
    kept = KeyframeImages(folder)
    for index in frames:
        status = FrameStatus.STARTING if index in starting else FrameStatus.TRACKED
        kept.on_frame(_frame(index), SimpleNamespace(keyframe=index in keyframes, status=status), None)
    stamps_s = np.array([100.0 + index for index in {*keyframes, *became}])
    kept.on_finish(SimpleNamespace(observations=lambda: SimpleNamespace(stamps_s=stamps_s)))


def test_keyframes_alone_are_kept_and_found_by_their_stamps(tmp_path):
    _played(tmp_path, range(6), {1, 4})
    run = SimpleNamespace(path=tmp_path, source=None, summary={})
    one, none, four = image_paths(run, np.array([101.0, 102.0, 104.0]))
    assert none is None
    for path, index in ((one, 1), (four, 4)):
        assert np.abs(cv2.imread(str(path)).astype(int) - _frame(index).image).mean() < 2.0


def test_frames_that_a_map_begins_with_later_are_kept(tmp_path):
    _played(tmp_path, range(6), {0, 3}, starting={0, 1, 2}, became={1})
    assert list(kept_images(tmp_path)) == [100.0, 101.0, 103.0]


def test_those_of_a_replaced_run_go_and_files_of_others_stay(tmp_path):
    _played(tmp_path, range(3), {0, 1, 2})
    (tmp_path / "images" / "notes.jpg").write_bytes(b"mine")
    _played(tmp_path, range(3), {2})
    assert list(kept_images(tmp_path)) == [102.0]
    assert (tmp_path / "images" / "notes.jpg").read_bytes() == b"mine"
