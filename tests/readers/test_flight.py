import pytest

from edgeslam_torch.readers.flight_folder import telemetry_gap
from edgeslam_torch.readers.source import open_source
from edgeslam_torch.types import TelemetrySample


def samples(begin_s, end_s, without=(0.0, 0.0)):
    stamps = [begin_s + 0.1 * k for k in range(round(10 * (end_s - begin_s)) + 1)]
    return [TelemetrySample(s) for s in stamps if not without[0] < s < without[1]]


@pytest.mark.parametrize(
    ("told", "words"),
    [
        (samples(0.0, 30.0), "all of it (0.0 to 30.0 s) is stamped before the frames (100.0 to 130.0 s), and none is"),
        (samples(1305031102.0, 1305031132.0), "is stamped after the frames"),
        (samples(110.0, 150.0), "no telemetry during 10.0 of 30.0 s"),
        (samples(90.0, 112.0), "no telemetry during 18.0 of 30.0 s"),
        (samples(90.0, 150.0, without=(105.0, 115.0)), "no telemetry during 10.0 of 30.0 s"),
        (samples(90.0, 150.0), None),
        (samples(100.4, 129.7), None),
        ([], None),
    ],
)
def test_telemetry_of_another_time_or_of_half_the_video_is_said(told, words):
    warning = telemetry_gap(told, 100.0, 130.0)
    assert warning is None if words is None else words in warning


def test_an_empty_telemetry_file_is_a_warning_of_the_source(tmp_path, write_tum):
    folder = write_tum(tmp_path / "seq", 3)
    (folder / "telemetry.csv").write_text("stamp_s,vgx,vgy,vgz,pitch,roll,yaw\n")
    source = open_source(folder)
    assert source.telemetry == []
    assert any("telemetry.csv: holds no state message" in w for w in source.warnings)
