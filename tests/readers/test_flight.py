import pytest

from edgeslam_torch.readers.flight_folder import telemetry_gap
from edgeslam_torch.readers.source import open_source
from edgeslam_torch.types import TelemetrySample


def samples(begin_s, end_s, without=(0.0, 0.0)):
    stamps = [begin_s + 0.1 * k for k in range(round(10 * (end_s - begin_s)) + 1)]
    return [TelemetrySample(s) for s in stamps if not without[0] < s < without[1]]


@pytest.mark.parametrize(("begin_s", "end_s"), [(90.0, 150.0), (100.4, 129.7)])
def test_telemetry_of_the_whole_video_is_no_news(begin_s, end_s):
    assert telemetry_gap(samples(begin_s, end_s), 100.0, 130.0) is None


@pytest.mark.parametrize(
    ("begin_s", "end_s", "words"),
    [
        (0.0, 30.0, "(0.0 to 30.0 s) is stamped before the frames (100.0 to 130.0 s)"),
        (1305031102.0, 1305031132.0, "is stamped after the frames"),
    ],
)
def test_telemetry_of_another_time_is_said_with_both_clocks(begin_s, end_s, words):
    warning = telemetry_gap(samples(begin_s, end_s), 100.0, 130.0)
    assert words in warning
    assert "none is used" in warning


@pytest.mark.parametrize(
    ("told", "missing_s"),
    [(samples(110.0, 150.0), 10.0), (samples(90.0, 112.0), 18.0), (samples(90.0, 150.0, (105.0, 115.0)), 10.0)],
)
def test_half_a_video_without_telemetry_is_counted(told, missing_s):
    warning = telemetry_gap(told, 100.0, 130.0)
    assert f"no telemetry during {missing_s:.1f} of 30.0 s" in warning


def test_no_telemetry_at_all_is_no_gap():
    assert telemetry_gap([], 100.0, 130.0) is None


def test_an_empty_telemetry_file_is_a_warning_of_the_source(tmp_path, write_tum):
    folder = write_tum(tmp_path / "seq", 3)
    (folder / "telemetry.csv").write_text("stamp_s,vgx,vgy,vgz,pitch,roll,yaw\n")
    source = open_source(folder)
    assert source.telemetry == []
    assert any("telemetry.csv: holds no state message" in w for w in source.warnings)
