"""Simulated flights are recorded once for all judges, also for those that run at the same time."""

from edgeslam_torch.eval.judge import flights


def test_judges_that_record_one_flight_at_a_time_leave_it_whole(tmp_path, monkeypatch):
    folder = tmp_path / "room-s0"
    begun = []

    def record(part, course, seed):
        part.mkdir()
        begun.append(part)
        (part / "first").touch()
        if len(begun) == 1:  # another judge begins and ends meanwhile
            assert flights.main("room", 0, folder) == 0
        (part / "second").touch()

    monkeypatch.setattr(flights, "record_course", record)

    assert flights.main("room", 0, folder) == 0

    assert sorted(p.name for p in folder.iterdir()) == ["first", "second"]
    assert [p.name for p in tmp_path.iterdir()] == ["room-s0"]
    assert len(set(begun)) == 2
