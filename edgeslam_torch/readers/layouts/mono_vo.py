"""``images/`` with ``times.txt`` beside it, as the TUM monoVO data set and DSO have it.

Other pictures beside them, such as ``vignette.png``, are not the recording.

https://cvg.cit.tum.de/data/datasets/mono-dataset: a line of ``times.txt`` is ``name stamp exposure``.
"""

from pathlib import Path

import numpy as np

from edgeslam_torch.errors import SourceError
from edgeslam_torch.files.tables import read_table
from edgeslam_torch.readers.images import image_files, list_image_folder
from edgeslam_torch.readers.layouts import tum
from edgeslam_torch.readers.listing import ImageEntry, Problem, entries_in_time
from edgeslam_torch.readers.sequence import Sequence
from edgeslam_torch.types import FloatArray

KIND = "mono_vo"
_IMAGES = "images"
_TIMES = "times.txt"


def recognises(folder: Path) -> bool:
    """Whether most of the folder's pictures lie in ``images/``, and no list names them."""
    images = folder / _IMAGES
    return images.is_dir() and not tum.recognises(folder) and len(image_files(images)) > len(image_files(folder))


def read(folder: Path) -> Sequence:
    """Images with the stamps of ``times.txt``, else by their names.

    Raises:
        SourceError: If ``times.txt`` does not fit the images.
    """
    times, truth = folder / _TIMES, folder / "groundtruth.txt"
    images, problems = _timed(folder / _IMAGES, times) if times.is_file() else list_image_folder(folder / _IMAGES)
    return Sequence(KIND, folder, tuple(images), tuple(problems), truth if truth.is_file() else None)


def _timed(folder: Path, times: Path) -> tuple[list[ImageEntry], list[Problem]]:
    files = image_files(folder)
    table = read_table(times, SourceError)
    several = bool(table.rows) and len(table.rows[0].cells) > 1
    stamps = table.numbers([1 if several else 0])[:, 0]
    by_name = {row.cells[0]: stamp for row, stamp in zip(table.rows, stamps.tolist(), strict=False)}
    given = {path: by_name.get(path.stem, by_name.get(path.name)) for path in files} if several else {}
    named = {path: stamp for path, stamp in given.items() if stamp is not None}
    if named:
        left_out = [Problem(str(path), f"is not in {times.name}") for path in files if path not in named]
        kept, problems = entries_in_time([*named.values()], [*named], str(times))
        return kept, left_out + problems
    if len(stamps) != len(files):
        raise SourceError(f"{times}: {len(stamps)} lines for {len(files)} images; a line is 'name stamp'")
    return entries_in_time(_column_of_times(table.numbers()), files, str(times))


def _column_of_times(numbers: FloatArray) -> FloatArray:
    """The second column of ``number stamp``, else the first."""
    counts = numbers.shape[1] > 1 and bool(np.all(np.diff(numbers[:, 0]) == 1))
    return np.asarray(numbers[:, 1 if counts else 0])
