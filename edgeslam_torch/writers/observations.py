"""``observations.npz``: which keyframe saw which anchor at which pixel."""

import zipfile
from pathlib import Path

import numpy as np

from edgeslam_torch.errors import SourceError
from edgeslam_torch.files.atomic import write_atomically
from edgeslam_torch.files.plain import open_plain
from edgeslam_torch.types import Observations

_MAX_BYTES = 1 << 29
"""Of the tables, unpacked: an hour of flight has some 50 MB; a damaged or hostile file may claim any size."""


def write_observations(path: Path, seen: Observations) -> None:
    """Write the file, atomically."""
    arrays = {
        "stamps_s": seen.stamps_s,
        "keyframe": seen.keyframe.astype(np.int32),
        "anchor": seen.anchor.astype(np.int32),
        "uv": seen.uv.astype(np.float32),
    }
    write_atomically(path, lambda file: np.savez_compressed(file, allow_pickle=False, **arrays))


def read_observations(path: Path) -> Observations:
    """Read the file.

    Raises:
        SourceError: If it is missing or damaged.
    """
    try:
        with open_plain(path) as plain, zipfile.ZipFile(plain) as packed:
            if sum(member.file_size for member in packed.infolist()) > _MAX_BYTES:
                raise SourceError(f"{path}: unpacks to more than {_MAX_BYTES >> 20} MiB; it is not read")
        with np.load(path, allow_pickle=False) as file:
            seen = Observations(file["stamps_s"], file["keyframe"], file["anchor"], file["uv"])
    except FileNotFoundError as error:
        raise SourceError(f"{path}: not there; the run was made by an older version, make it again") from error
    except (OSError, ValueError, KeyError, EOFError, MemoryError, zipfile.BadZipFile, NotImplementedError) as error:
        raise SourceError(f"{path}: damaged ({error}); make the run again") from error
    count = len(seen.keyframe)
    if seen.anchor.shape != (count,) or seen.uv.shape != (count, 2) or seen.stamps_s.ndim != 1:
        raise SourceError(f"{path}: its tables do not fit one another; make the run again")
    if count and not (seen.keyframe.min() >= 0 and seen.keyframe.max() < len(seen.stamps_s) and seen.anchor.min() >= 0):
        raise SourceError(f"{path}: an observation names no keyframe; make the run again")
    return seen
