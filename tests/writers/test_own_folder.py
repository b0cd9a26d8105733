"""Which folders results may be written to."""

from contextlib import nullcontext

import pytest

from edgeslam_torch.errors import OutputError
from edgeslam_torch.writers.own_folder import check_free, check_pictures


def never(folder):
    return False


@pytest.mark.parametrize("name", ["flight.mp4", "flight.bag", "flight.db3", "FLIGHT.MCAP", "0.png", "mine.json"])
def test_a_folder_with_a_recording_or_with_a_result_of_others_is_not_free(tmp_path, name):
    check_free(tmp_path, ["mine.json"], never)
    (tmp_path / name).touch()
    with pytest.raises(OutputError):
        check_free(tmp_path, ["mine.json"], never)
    check_free(tmp_path, ["mine.json"], lambda folder: folder == tmp_path)


def test_a_folder_that_is_not_there_or_empty_below_is_free(tmp_path):
    (tmp_path / "cells").mkdir()
    check_free(tmp_path, ["cells"], never)
    check_free(tmp_path / "nowhere", ["cells"], never)


@pytest.mark.parametrize(("number", "is_free"), [(2, True), (3, False)])
def test_pictures_are_not_added_to_a_recording_of_pictures(tmp_path, number, is_free):
    for name in [*(f"{i}.png" for i in range(number)), *(f"own_{i}.png" for i in range(5))]:
        (tmp_path / name).touch()
    with nullcontext() if is_free else pytest.raises(OutputError):
        check_pictures(tmp_path, lambda path: path.name.startswith("own_"), "give another folder")
