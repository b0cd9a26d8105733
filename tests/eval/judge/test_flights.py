"""Simulated flights are recorded once for all judges, also for those that run at the same time."""

from concurrent.futures import ThreadPoolExecutor

import pytest

from edgeslam_torch.errors import OutputError
from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.judge import flights


def test_flight_is_recorded_once_and_only_whole(tmp_path, monkeypatch):
    calls = []

    def record(part, course, seed, flight):
        calls.append(seed)
        if seed == 3:
            raise OutputError("no space left")
        part.mkdir()

    monkeypatch.setattr(flights, "record_course", record)
    monkeypatch.setattr(flights, "ProcessPoolExecutor", lambda count, context: ThreadPoolExecutor(count))
    first = flights.flight_folder(tmp_path, "room", 2)
    assert flights.flight_folder(tmp_path, "room", 2) == first and first.is_dir() and calls == [2]
    with pytest.raises(EvaluationError, match="room, seed 3: could not be recorded: no space left"):
        flights.flight_folder(tmp_path, "room", 3)
    assert list(tmp_path.iterdir()) == [first]


def test_judges_that_record_one_flight_at_a_time_leave_it_whole(tmp_path, monkeypatch):
    folder = tmp_path / "room-s0"
    begun = []

    def record(part, course, seed, flight):
        part.mkdir()
        begun.append(part)
        (part / "first").touch()
        if len(begun) == 1:  # another judge begins and ends meanwhile
            flights.record_once(folder, "room", 0)
        (part / "second").touch()

    monkeypatch.setattr(flights, "record_course", record)

    flights.record_once(folder, "room", 0)

    assert sorted(p.name for p in folder.iterdir()) == ["first", "second"]
    assert [p.name for p in tmp_path.iterdir()] == ["room-s0"]
    assert len(set(begun)) == 2
