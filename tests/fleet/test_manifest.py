"""Folders, patterns and tables of recordings."""

import pytest

from edgeslam_torch.errors import ConfigError, SourceError
from edgeslam_torch.fleet.manifest import read_manifests


@pytest.fixture
def recordings(tmp_path, write_images):
    for name in ("b", "a"):
        write_images(tmp_path / "all" / name, ["0.png"])
    (tmp_path / "all" / "broken").mkdir()
    (tmp_path / "all" / "clip.mp4").touch()
    (tmp_path / "all" / "notes.txt").touch()
    (tmp_path / "all" / ".hidden").mkdir()
    return tmp_path / "all"


def names(*manifests):
    return [flight.name for flight in read_manifests([str(m) for m in manifests])]


def table(tmp_path, text):
    path = tmp_path / "flights.csv"
    path.write_text(text)
    return path


def test_every_folder_and_video_of_a_folder_is_a_flight_and_same_names_are_numbered(recordings, tmp_path, write_images):
    assert names(recordings) == ["a", "b", "broken", "clip.mp4"]
    places = [tmp_path / name for name in ("one/flight", "two/Flight", "three/flight")]  # their case differs
    for place in places:
        write_images(place, ["0.png"])
    assert names(*places) == ["flight", "Flight-2", "flight-3"]


def test_table_gives_each_flight_its_own_camera_truth_and_settings(tmp_path):
    rows = "recording, name, camera, truth, settings\nf/1,first,tello,,orb.features=500; seed=3\n/x/2,,c.yaml,t.txt,\n"
    first, second = read_manifests([str(table(tmp_path, rows))])
    assert (first.recording, first.name, first.camera) == (tmp_path / "f" / "1", "first", "tello")
    assert first.settings == ("orb.features=500", "seed=3")
    assert first.origin.endswith("flights.csv, line 2")
    assert str(second.recording) == "/x/2"
    assert second.name == "2"
    assert (second.camera, second.truth) == (str(tmp_path / "c.yaml"), str(tmp_path / "t.txt"))


@pytest.mark.parametrize(
    "text", ["recording,tuth\na,b\n", "name,camera\na,b\n", "recording\n", "", "recording,name\n,x\n",
             "recording\na,b,c\n", "recording\ntello://\n"],
)  # fmt: skip
def test_malformed_table_is_refused_by_name(tmp_path, text):
    with pytest.raises((ConfigError, SourceError), match=r"flights\.csv"):
        read_manifests([str(table(tmp_path, text))])
