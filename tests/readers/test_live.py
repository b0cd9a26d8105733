import signal
import threading

import pytest
from fake_feed import FakeFeed

from edgeslam_torch.cli import main
from edgeslam_torch.drone.emulator.server import TelloEmulator
from edgeslam_torch.drone.video_stream import Picture
from edgeslam_torch.errors import SourceError
from edgeslam_torch.readers.live import LiveSource


def live(feed):
    return LiveSource("webcam:0", feed, None, None)


def test_frames_carry_the_gaps_of_what_was_missed():
    feed = FakeFeed([1, 2, 5])
    source = live(feed)
    assert [f.index for f in source.frames()] == [0, 1, 4]
    assert "no picture" in source.problems[0].reason
    assert feed.closed == 1
    source.close()
    assert [w for w in source.warnings if "refused" in w] == ["webcam:0: 3 packets refused"]
    assert source.live
    assert source.length is None


def sized(feed, counts):
    """The same feed with pictures of half the size among these counts."""
    feed.pictures = [Picture(p.stamp_s, p.image[:24, :32], p.count) if p.count in counts else p for p in feed.pictures]
    return feed


def test_a_picture_of_an_odd_size_is_left_out_and_said():
    source = live(sized(FakeFeed(range(1, 9)), {3, 4, 6}))
    assert [f.index for f in source.frames()] == [0, 1, 4, 6, 7]
    assert sum("32x24, not 64x48" in problem.reason for problem in source.problems) == 1


def test_another_resolution_for_seconds_ends_the_source_with_its_reason():
    feed = sized(FakeFeed(range(1, 90)), range(10, 90))
    frames = live(feed).frames()
    assert sum(1 for _, frame in zip(range(9), frames, strict=False) if frame.image.shape[:2] == (48, 64)) == 9
    with pytest.raises(SourceError, match=r"webcam:0: pictures are 32x24 now and were 64x48.*start again"):
        next(frames)
    assert feed.closed == 1


def test_a_source_that_is_ended_stops_while_it_waits():
    feed = FakeFeed([1, 2])
    source = live(feed)
    wait = feed.wait

    def silent(after_count, timeout_s):
        if after_count == 2:
            source.end()
        return wait(after_count, timeout_s)

    feed.wait = silent
    assert len(list(source.frames())) == 2
    assert source.problems == []
    assert feed.closed == 1


@pytest.mark.slow
@pytest.mark.alone
@pytest.mark.timeout(120)
@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="signals as POSIX has them")
def test_emulator_ends_whichever_of_its_threads_gets_the_signal(capsys, monkeypatch):
    start = TelloEmulator.start

    def shot(emulator):
        threading.Timer(0.5, lambda: signal.pthread_kill(threading.get_ident(), signal.SIGTERM)).start()
        return start(emulator)

    monkeypatch.setattr(TelloEmulator, "start", shot)
    ports = ["--command-port", "0", "--state-port", "1", "--video-port", "1"]
    assert main(["sim", *ports, "--render-width", "64"]) == 0


def test_device_is_given_back_when_the_taker_stops_early():
    feed = FakeFeed(range(1, 50))
    frames = live(feed).frames()
    next(frames)
    frames.close()
    assert feed.closed == 1


def test_no_picture_is_an_error_and_gives_the_device_back():
    feed = FakeFeed([])
    with pytest.raises(SourceError, match="no picture"):
        live(feed)
    assert feed.closed == 1
