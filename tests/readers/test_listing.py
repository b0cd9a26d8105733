from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edgeslam_torch.errors import SourceError
from edgeslam_torch.readers.listing import ImageEntry, entries_in_time, in_order, read_list
from edgeslam_torch.readers.source import open_source


def entries(stamps):
    return [ImageEntry(i, float(s), Path(f"{i}.png")) for i, s in enumerate(stamps)]


def test_one_wild_stamp_costs_one_image():
    stamps = [*range(10), 1e6, *range(11, 20)]
    kept, problems = in_order(entries(stamps), "rgb.txt")
    assert [e.index for e in kept] == [*range(10), *range(11, 20)]
    assert len(problems) == 1
    assert "10.png" in problems[0].file
    assert "out of order" in problems[0].reason


def test_a_list_that_runs_backwards_is_used_forwards_and_costs_nothing():
    kept, problems = in_order(entries([4, 3, 2, 2, 1]), "rgb.txt")
    assert [e.stamp_s for e in kept] == [1, 2, 3, 4]
    assert "from the last to the first" in problems[0].reason
    assert [p.frames for p in problems] == [0, 1]  # the list, and the repetition


@given(st.lists(st.floats(-1e9, 1e9), max_size=60))
def test_whatever_the_stamps_the_result_increases_and_nothing_vanishes_silently(stamps):
    try:
        kept, problems = in_order(entries(stamps), "rgb.txt")
    except SourceError:
        assert 2 * len(set(stamps)) < len(stamps)
        return
    assert np.all(np.diff([e.stamp_s for e in kept]) > 0)
    named = [p for p in problems if p.file != "rgb.txt"]
    assert len(kept) + len(named) == len(stamps)


@pytest.mark.parametrize("begin_s", [0.0, 328551.5, 1305031102.2])
@pytest.mark.parametrize(("factor", "word"), [(1.0, ""), (1e3, "milli"), (1e6, "micro"), (1e9, "nano")])
def test_stamps_in_any_unit_become_seconds_and_a_relative_clock_is_said(begin_s, factor, word):
    stamps = [factor * (begin_s + i / 20) for i in range(30)]
    kept, problems = entries_in_time(stamps, [Path(f"{i}.png") for i in range(30)], "rgb.txt")
    assert np.allclose([entry.stamp_s for entry in kept], begin_s + np.arange(30) / 20, atol=1e-5)
    assert [word in problem.reason for problem in problems] == ([True] if word and begin_s < 1e9 else [])


@pytest.mark.parametrize(("step", "said"), [(1, "numbers"), (10, "numbers"), (1e-5, "no unit"), (0.5, ""), (1.01, "")])
def test_frame_numbers_and_other_numbers_in_place_of_stamps_are_said(step, said):
    stamps = step * np.arange(30) + 0.001 * (step == 1.01) * np.arange(30) ** 2
    kept, problems = entries_in_time(stamps, [Path(f"{i}.png") for i in range(30)], "rgb.txt")
    assert len(kept) == 30
    assert [said in problem.reason for problem in problems] == [True] * bool(said)


@pytest.mark.parametrize("stamp", [float("nan"), 1e154, -1e154, float("inf")])
def test_what_is_no_time_costs_its_image(stamp):
    kept, problems = entries_in_time([0.0, 0.1, stamp, 0.3, stamp], [Path(f"{i}.png") for i in range(5)], "rgb.txt")
    assert [entry.index for entry in kept] == [0, 1, 3]
    assert len(problems) == 2


@pytest.mark.parametrize("layout", ["rgb.txt", "mav0/cam0/data.csv"])
def test_stamps_that_are_no_times_are_named_as_the_cause(tmp_path, write_images, layout):
    """Windows counts tenths of a microsecond since 1601."""
    names = [f"{i}.png" for i in range(12)]
    place = tmp_path / layout
    write_images(place.parent / ("data" if "mav0" in layout else ""), names)
    place.write_text("".join(f"{129495623021753040 + 333333 * i},{name}\n" for i, name in enumerate(names)))
    with pytest.raises(SourceError, match=r"none of its stamps is a time, such as 1.29\d*e\+17"):
        open_source(tmp_path)


@pytest.mark.parametrize("line", ["{} {}", "{}\t{}", "{},{}", "{};{}", '"{}";"{}"', "{}, {}"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize("comma", [False, True])
def test_a_list_is_read_however_a_spreadsheet_wrote_it(tmp_path, line, encoding, comma):
    if comma and line.startswith("{},"):
        pytest.skip("decimal commas between commas need quotes")
    stamps = [f"{1305031102 + i / 8:.3f}".replace(".", "," if comma else ".") for i in range(4)]
    text = "#timestamp filename\n" + "\n".join(line.format(stamp, f"rgb/{i} a.png") for i, stamp in enumerate(stamps))
    (tmp_path / "rgb.txt").write_bytes(text.encode(encoding))
    rows, problems = read_list(tmp_path / "rgb.txt")
    assert rows == [(1305031102 + i / 8, f"rgb/{i} a.png") for i in range(4)]
    assert problems == []


def test_shuffled_list_is_sorted_and_said(rng):
    stamps = rng.permutation(50)
    kept, problems = in_order(entries(stamps), "rgb.txt")
    assert [e.stamp_s for e in kept] == sorted(stamps)
    assert [(p.file, p.frames) for p in problems] == [("rgb.txt", 0)]


def test_identical_stamps_are_named_as_the_cause():
    with pytest.raises(SourceError, match=r"rgb.txt: 40 images have only 4 different stamps"):
        in_order(entries(np.arange(40) // 10 + 1305031102), "rgb.txt")
