"""Videos whose pictures change their size, and damaged ones."""

import io

import cv2
import numpy as np
import pytest

from edgeslam_torch.errors import SourceError
from edgeslam_torch.readers.video import Video


def _mjpeg(width, height, count):
    picture = np.full((height, width, 3), 90, np.uint8)
    return cv2.imencode(".jpg", picture)[1].tobytes() * count


def _coded(codec, form):
    def stream(width, height, count):
        av = pytest.importorskip("av")
        clip = io.BytesIO()
        with av.open(clip, "w", format=form) as container:
            stream = container.add_stream(codec, rate=25, width=width, height=height, pix_fmt="yuv420p")
            texture = cv2.resize(np.random.default_rng(0).integers(0, 255, (12, 16, 3), np.uint8), (width, height))
            moving = (av.VideoFrame.from_ndarray(np.roll(texture, i, 1), format="bgr24") for i in range(count))
            for packet in [*(p for picture in moving for p in stream.encode(picture)), *stream.encode(None)]:
                container.mux(packet)
        return clip.getvalue()

    return stream


@pytest.mark.parametrize(
    ("suffix", "stream"),
    [
        (".mjpeg", _mjpeg),
        (".h264", _coded("libx264", "h264")),
        (".ts", _coded("libx264", "mpegts")),
        (".hevc", _coded("libx265", "hevc")),
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
    assert (
        "the resolution changes from 128x96 to 128x48 at frame 10: ended there; cut the video there" in problem.reason
    )
    assert problem.frames == 15


@pytest.mark.parametrize(("suffix", "stream"), [(".mjpeg", _mjpeg), (".h264", _coded("libx264", "h264"))])
def test_a_joined_video_of_one_resolution_is_read_to_its_end(tmp_path, suffix, stream):
    path = tmp_path / f"mix{suffix}"
    path.write_bytes(stream(128, 96, 10) + stream(128, 96, 15))
    problems = []
    assert len(list(Video(path).frames(problems))) == 25
    assert problems == []


@pytest.mark.parametrize(("suffix", "after"), [(".mp4", -40), (".mp4", -4), (".mov", 60)])
def test_a_video_that_was_cut_off_before_its_index_ends_is_named_so(tmp_path, suffix, after):
    whole = _coded("libx264", "mp4")(128, 96, 30)
    path = tmp_path / f"cut{suffix}"
    path.write_bytes(whole[: whole.index(b"moov") + after])
    with pytest.raises(SourceError, match="cut off: it has no index; copy it again, or repair it") as refused:
        Video(path)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("text", [b"not a video", b"\0\0\0\x08 and no moov in it", b"\0\0\0\x01moov"])
def test_what_is_no_video_is_not_said_to_be_cut_off(tmp_path, text):
    path = tmp_path / "text.mp4"
    path.write_bytes(text)
    with pytest.raises(SourceError, match="not a video that can be decoded"):
        Video(path)


def _noisy(stream, first, last):
    begin, end = int(first * len(stream)), int(last * len(stream))
    return stream[:begin] + np.random.default_rng(0).bytes(end - begin) + stream[end:]


def test_packets_of_a_stream_that_cannot_be_decoded_are_counted(tmp_path):
    path = tmp_path / "noisy.hevc"
    path.write_bytes(_noisy(_coded("libx265", "hevc")(320, 240, 100), 0.4, 0.6))
    problems = []
    given = len(list(Video(path).frames(problems)))
    (problem,) = problems
    assert problem.reason == f"{given} of {given + problem.frames} frames can be decoded; the file is damaged"
    assert problem.frames > 2


def test_pictures_that_are_missing_between_the_stamps_of_a_stream_are_said(tmp_path):
    path = tmp_path / "noisy.ts"
    path.write_bytes(_noisy(_coded("libx264", "mpegts")(320, 240, 100), 0.4, 0.6))
    problems = []
    given = len(list(Video(path).frames(problems)))
    (missing,) = (int(p.reason.split()[0]) for p in problems if "frames are missing by the stamps" in p.reason)
    assert given < 95
    assert given + missing == pytest.approx(100, abs=5)
