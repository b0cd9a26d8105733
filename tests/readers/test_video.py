"""Videos whose pictures change their size, and damaged ones."""

import numpy as np
import pytest
from streams import coded, mjpeg

from edgeslam_torch.errors import SourceError
from edgeslam_torch.readers.video import Video


@pytest.mark.parametrize(
    ("suffix", "stream"),
    [
        (".mjpeg", mjpeg),
        (".h264", coded("libx264", "h264")),
        (".ts", coded("libx264", "mpegts")),
        (".hevc", coded("libx265", "hevc")),
    ],
)
def test_a_joined_video_ends_where_its_resolution_changes_and_says_so(tmp_path, suffix, stream):
    path = tmp_path / f"mix{suffix}"
    path.write_bytes(stream(128, 96, 10) + stream(128, 48, 15))
    problems = []
    frames = list(Video(path).frames(problems))
    assert {frame.image.shape for frame in frames} == {(96, 128, 3)}
    assert len(frames) >= 8
    (problem,) = problems
    assert "resolution changes from 128x96 to 128x48 at frame 10: ended there; cut the video there" in problem.reason
    assert problem.frames == 15
    if suffix in (".mjpeg", ".h264"):
        path.write_bytes(stream(128, 96, 10) + stream(128, 96, 15))
        problems = []
        assert len(list(Video(path).frames(problems))) == 25
        assert problems == []


@pytest.mark.parametrize(
    ("name", "after", "words"),
    [
        ("cut.mp4", -40, "cut off: it has no index; copy it again, or repair it"),
        ("cut.mp4", -4, "cut off: it has no index; copy it again, or repair it"),
        ("cut.mov", 60, "cut off: it has no index; copy it again, or repair it"),
        ("text.mp4", b"not a video", "not a video that can be decoded"),
        ("text.mp4", b"\0\0\0\x08 and no moov in it", "not a video that can be decoded"),
        ("text.mp4", b"\0\0\0\x01moov", "not a video that can be decoded"),
    ],
)
def test_a_video_without_its_index_is_told_from_what_is_no_video(tmp_path, name, after, words):
    if isinstance(after, int):
        whole = coded("libx264", "mp4")(128, 96, 30)
        after = whole[: whole.index(b"moov") + after]
    (tmp_path / name).write_bytes(after)
    with pytest.raises(SourceError, match=words) as refused:
        Video(tmp_path / name)
    assert "\n" not in str(refused.value)


def _noisy(stream, first, last):
    begin, end = int(first * len(stream)), int(last * len(stream))
    return stream[:begin] + np.random.default_rng(0).bytes(end - begin) + stream[end:]


def test_packets_of_a_stream_that_cannot_be_decoded_are_counted(tmp_path):
    path = tmp_path / "noisy.hevc"
    path.write_bytes(_noisy(coded("libx265", "hevc")(320, 240, 100), 0.4, 0.6))
    problems = []
    given = len(list(Video(path).frames(problems)))
    (problem,) = problems
    assert problem.reason == f"{given} of {given + problem.frames} frames can be decoded; the file is damaged"
    assert problem.frames > 2


def test_pictures_that_are_missing_between_the_stamps_of_a_stream_are_said(tmp_path):
    path = tmp_path / "noisy.ts"
    path.write_bytes(_noisy(coded("libx264", "mpegts")(320, 240, 100), 0.4, 0.6))
    problems = []
    given = len(list(Video(path).frames(problems)))
    (missing,) = (int(p.reason.split()[0]) for p in problems if "frames are missing by the stamps" in p.reason)
    assert given < 95
    assert given + missing == pytest.approx(100, abs=5)
