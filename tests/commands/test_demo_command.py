"""``edgeslam demo``."""

import json

import numpy as np
import pytest

from edgeslam_torch.cli import main
from edgeslam_torch.demo import DemoSettings, map_accuracy, record, run_and_judge
from edgeslam_torch.errors import OutputError
from edgeslam_torch.readers.source import open_source

SMALL = ["--world", "corridor", "--rate", "5", "--width", "160", "--seed", "3", "--record-only"]


@pytest.mark.slow
def test_recordings_have_different_places_can_be_run_and_are_not_made_again(tmp_path, capsys):
    def first_images(flights):
        assert main(["demo", "--out", str(tmp_path), "--flights", flights, "--duration", "1", *SMALL]) == 0
        return [next(open_source(str(folder)).frames()).image for folder in sorted(tmp_path.glob("flight_*"))]

    (alone,) = first_images("1")
    made = (tmp_path / "flight_0003" / "rgb.txt").stat().st_mtime_ns
    first, second = first_images("2")
    assert (tmp_path / "flight_0003" / "rgb.txt").stat().st_mtime_ns == made
    assert (first == alone).all() and np.abs(first.astype(int) - second).mean() > 5
    source = open_source(str(tmp_path / "flight_0003"))
    assert [frame.image.shape for frame in source.frames()] == [(120, 160, 3)] * 5
    assert source.telemetry and source.groundtruth is not None


def test_a_demo_clears_no_recording_of_somebody_else(tmp_path):
    (tmp_path / "rgb").mkdir()
    (tmp_path / "rgb" / "1.0.png").write_text("theirs")
    with pytest.raises(OutputError, match="--out"):
        record(tmp_path, DemoSettings(world="corridor", seconds=1.0, rate_hz=5.0, width=160, height=120))
    assert (tmp_path / "rgb" / "1.0.png").read_text() == "theirs"


@pytest.mark.parametrize(
    ("name", "words"),
    [("rgb.txt", []), ("demo.json", []), ("trajectory.txt", []), ("rgb.txt", ["--record-only"])]
    + [("flight.mp4", ["--record-only", "--flights", "2"])],
)
def test_a_folder_of_others_is_refused_before_the_flight(tmp_path, monkeypatch, name, words):
    monkeypatch.setattr("edgeslam_torch.demo.record", lambda *given: pytest.fail("flown"))
    (tmp_path / name).write_text("precious")
    assert main(["demo", "--out", str(tmp_path), *words]) == 1
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {name: "precious"}


@pytest.mark.slow
def test_demo_runs_and_judges_itself(tmp_path):
    settings = DemoSettings(seconds=6.0, rate_hz=12.0, width=320, height=240)
    recorded = record(tmp_path / "flight", settings)
    demo = run_and_judge(tmp_path, recorded, settings)
    assert demo.run.summary["frames"] == 72
    # Six seconds in small pictures; .011 m of 2.03, .12 live (the metre is corrected late), map 4.3 cm when written.
    assert demo.score.coverage == 1.0
    assert demo.path_m == pytest.approx(2.03, abs=0.01)
    assert demo.score.ate_sim3_m < 0.025
    assert demo.score.ate_online_sim3_m < 0.15
    assert abs(demo.score.scale_error) < 0.05
    # So short a flight states too little: 1.9 sigmas off in the mean square of nine seeds, .8 in flights of 20 s.
    assert abs(demo.score.scale_error) < 3.5 * demo.run.summary["scale"]["sigma"] / demo.run.summary["scale"]["value"]
    assert demo.map is not None
    assert demo.map.points > 10_500  # 11 to 12 thousand: telemetry that moves the scale by a percent moves a twentieth
    assert demo.map.median_m < 0.065
    written = json.loads((tmp_path / "demo.json").read_text())
    assert written["frames"] == 72
    assert written["settings"]["world"] == "room"
    assert written["trajectory"]["ate_sim3_m"] == pytest.approx(demo.score.ate_sim3_m)
    again = map_accuracy(tmp_path, demo.score, recorded.world)
    assert again == demo.map


@pytest.mark.parametrize(
    "arguments",
    [["--world", "castle"], ["--duration", "0"], ["--images", "awful"], ["--loss", "150"], ["--seed", "-3"],
     ["--flights", "3"], ["--width", "641"]],
)  # fmt: skip
def test_wrong_options_are_reported_in_one_line(tmp_path, capsys, arguments):
    assert main(["demo", "--out", str(tmp_path), *arguments]) == 1
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
