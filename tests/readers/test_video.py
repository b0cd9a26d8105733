"""Videos whose pictures change their size."""

import io

import cv2
import numpy as np
import pytest

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
            picture = av.VideoFrame.from_ndarray(np.full((height, width, 3), 90, np.uint8), format="bgr24")
            for packet in [*(p for _ in range(count) for p in stream.encode(picture)), *stream.encode(None)]:
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
