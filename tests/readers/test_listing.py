from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edgeslam_torch.readers.listing import ImageEntry, Problem, in_order, seconds_from


def entries(stamps):
    return [ImageEntry(i, float(s), Path(f"{i}.png")) for i, s in enumerate(stamps)]


def test_one_wild_stamp_costs_one_image():
    stamps = [*range(10), 1e6, *range(11, 20)]
    kept, problems = in_order(entries(stamps), "rgb.txt")
    assert [e.index for e in kept] == [*range(10), *range(11, 20)]
    assert len(problems) == 1
    assert "10.png" in problems[0].file
    assert "out of order" in problems[0].reason


def test_repeated_stamp_is_left_out_and_named():
    kept, problems = in_order(entries([*range(10), 9, 10, 11, 12]), "rgb.txt")
    assert len(kept) == 13
    assert "repetition" in problems[0].reason


def test_shuffled_list_is_sorted(rng):
    stamps = rng.permutation(50)
    kept, problems = in_order(entries(stamps), "rgb.txt")
    assert [e.stamp_s for e in kept] == sorted(stamps)
    assert problems == [
        Problem("rgb.txt", "lists images in no order of their stamps; they are used sorted by stamp", 0)
    ]


def test_a_list_that_runs_backwards_is_used_forwards_and_costs_nothing():
    kept, problems = in_order(entries([4, 3, 2, 2, 1]), "rgb.txt")
    assert [e.stamp_s for e in kept] == [1, 2, 3, 4]
    assert problems[0] == Problem(
        "rgb.txt", "lists images from the last to the first; they are used sorted by stamp", frames=0
    )
    assert [p.frames for p in problems[1:]] == [1]  # the repetition


@given(st.lists(st.floats(-1e9, 1e9), max_size=60))
def test_whatever_the_stamps_the_result_increases_and_nothing_vanishes_silently(stamps):
    kept, problems = in_order(entries(stamps), "rgb.txt")
    assert np.all(np.diff([e.stamp_s for e in kept]) > 0)
    named = [p for p in problems if p.file != "rgb.txt"]
    assert len(kept) + len(named) == len(stamps)


@pytest.mark.parametrize(
    ("stamp", "unit"),
    [(1305031102.17, "s"), (1305031102175.0, "ms"), (1305031102175304.0, "us"), (1.403e18, "ns"), (12.5, "s")],
)
def test_unit_of_stamps_is_told_by_their_size(stamp, unit):
    seconds, found = seconds_from([stamp])
    assert found == unit
    assert seconds[0] < 4e9
