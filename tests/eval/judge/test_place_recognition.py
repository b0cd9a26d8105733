"""Links between maps of one place and of different places; the maps are those of a film of stairs."""

from dataclasses import replace

import numpy as np
import pytest
from rendered import CAMERA, film, sideways, stairs_world

from edgeslam_torch.config import SlamConfig
from edgeslam_torch.eval.judge import place_recognition
from edgeslam_torch.eval.judge.place_recognition import AWAY_S, Half, _flown, compare, fly_room, main
from edgeslam_torch.geometry import se3
from edgeslam_torch.readers.source import Recording


@pytest.fixture(scope="module")
def half():
    """A map of the stairs, and where its keyframes truly were; the stamps are those of the first pass."""
    flight = film(stairs_world(), CAMERA, sideways(30, 0.03))
    source = Recording("stairs", "images", "stairs", CAMERA, lambda _: iter(flight.frames), len(flight.frames))
    atlas, stamps = _flown(source, "stairs")
    rows = [int(np.abs(flight.stamps_s - t).argmin()) for t in stamps]
    np.testing.assert_allclose(flight.stamps_s[rows], stamps)
    return Half("stairs", "first", atlas, stamps, flight.T_w_c[rows])


def test_two_passes_of_one_place_are_linked_and_recalled(half):
    later = replace(half, name="second", stamps_s=half.stamps_s + 60.0)
    found = compare(half, later, SlamConfig())
    assert found.links > 0
    assert (found.false, found.agreeing) == (0, False)
    assert found.revisits == 2 * len(half.stamps_s)
    assert found.recalled >= 0.8 * found.revisits


def test_links_between_recordings_of_different_places_are_false(half):
    found = compare(half, replace(half, recording="elsewhere"), SlamConfig())
    assert found.false == found.links > 0
    assert found.revisits == 0


def test_a_link_that_is_off_by_the_truth_is_false(half):
    """The other half was a metre higher, so that nothing was visited twice."""
    up = se3.exp(np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))
    later = replace(half, name="second", stamps_s=half.stamps_s + 60.0, T_w_c=up @ half.T_w_c)
    found = compare(half, later, SlamConfig())
    assert found.false == found.links > 0
    assert found.revisits == 0


def test_what_was_seen_just_before_is_no_revisit(half):
    assert compare(half, replace(half, name="second"), SlamConfig()).revisits == 0


def test_a_folder_without_recordings_is_no_success(tmp_path, capsys):
    assert main(["--data", str(tmp_path), "--out", str(tmp_path / "maps")]) == 1
    said = capsys.readouterr()
    assert "fewer than two flights with ground truth" in said.err and "links" not in said.out


def test_a_missing_folder_is_one_line(tmp_path, capsys):
    assert main(["--data", str(tmp_path / "none"), "--out", str(tmp_path / "maps")]) == 1
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.slow
def test_a_simulated_room_is_flown_once_on_each_path_and_known_to_the_truth(tmp_path, monkeypatch):
    monkeypatch.setattr(place_recognition, "ROOM_S", 3.0)
    first, second = fly_room(3, 0, tmp_path), fly_room(3, 1, tmp_path)
    assert (first.recording, second.recording) == ("room 3", "room 3")
    assert first.stamps_s.max() < 3.0 and second.stamps_s.min() >= 3.0 + AWAY_S
    for half in (first, second):
        assert np.isfinite(half.T_w_c).all() and 0.5 < half.metres < 2.0
    made = {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    again = fly_room(3, 1, tmp_path)
    np.testing.assert_array_equal(again.stamps_s, second.stamps_s)
    assert made == {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()}


def test_recordings_or_rooms_must_be_asked_for(tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(["--out", str(tmp_path)])
    assert "one of the arguments --data --rooms is required" in capsys.readouterr().err
