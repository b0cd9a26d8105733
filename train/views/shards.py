"""Images with depth in tar files, for sets larger than memory; the layout is WebDataset's.

A sample is the files of one name up to the first dot: ``000001.jpg`` (or png), ``000001.depth.png`` (16 bits) or
``000001.depth.npy`` (metres), and ``000001.json`` with ``fx``, ``fy``, ``cx``, ``cy`` of the undistorted image [px]
and ``depth_per_m`` of a png. Nothing is unpacked: the places of all files are read once, and a sample when it is drawn.

Any recording with depth becomes shards by ``python -m edgeslam_torch.train.views.shards RECORDING... --out FOLDER``.
"""

import argparse
import hashlib
import io
import json
import tarfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.errors import SourceError
from edgeslam_torch.files.atomic import write_atomically
from edgeslam_torch.files.plain import open_plain
from edgeslam_torch.models.record import FOCAL_RANGE
from edgeslam_torch.readers.images import decode
from edgeslam_torch.train.views.augment import View
from edgeslam_torch.train.views.datasets import DepthFolder, load_depth_folder, reduced, warn_of

IMAGES, DEPTHS = ("jpg", "jpeg", "png"), ("depth.png", "depth.npy")
PARTS = {"image": IMAGES, "depth": DEPTHS, "calibration (json)": ("json",)}
"""What a sample has, and the extensions of each."""
DEPTH_PER_M = 1000.0
"""Default for a depth.png whose json has no ``depth_per_m``."""
TAIL = 64
"""Number of bytes at the end of each file that are compared to detect changes."""
_UNREADABLE = (
    OSError,
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    ArithmeticError,
    MemoryError,
    RecursionError,
)
PER_SHARD = 1000
"""Samples in a file that `write_shards` writes; about 200 MB."""


@dataclass(frozen=True, slots=True)
class _Sample:
    shard: Path
    name: str
    files: dict[str, tuple[int, int]]
    """By extension: offset and size in the tar [bytes]."""

    def read(self, extension: str, last: int | None = None) -> bytes:
        """A file, or its last bytes."""
        offset, size = self.files[extension]
        length = size if last is None else min(last, size)
        with self.shard.open("rb") as file:
            file.seek(offset + size - length)
            content = file.read(length)
        if len(content) != length:
            raise ValueError("the file is shorter than when training began")
        return content


class ShardedViews(Sequence[View]):
    """Views of tar files, read, decoded and reduced to a width [px] on access; nothing is cached."""

    def __init__(self, samples: Sequence[_Sample], width: int) -> None:
        self._samples, self._width = samples, width

    def __len__(self) -> int:
        return len(self._samples)

    def __getitem__(self, index: int) -> View:  # type: ignore[override]  # no slices
        """One view.

        Raises:
            SourceError: If the sample cannot be read; names it.
        """
        sample = self._samples[index]
        try:
            return reduced(_decoded(sample), self._width)
        except (SourceError, *_UNREADABLE) as error:
            why = " ".join(str(error).split())[:120]
            raise SourceError(f"{sample.shard}: {sample.name} cannot be read ({why})") from error


def is_sharded(path: Path) -> bool:
    """Whether this is a tar file or a folder of them."""
    return path.suffix == ".tar" if path.is_file() else any(path.glob("*.tar"))


def load_shards(path: Path, width: int = 400, max_frames: int | None = None) -> DepthFolder:
    """The first ``max_frames`` samples of a tar file or a folder of them, unread; ``width`` is as of `ShardedViews`.

    Raises:
        SourceError: If a file is damaged or compressed, or there is no whole sample.
    """
    shards = sorted(path.glob("*.tar")) if path.is_dir() else [path]
    samples: list[_Sample] = []
    left_out: list[str] = []
    digest = hashlib.sha256()
    for sample in (sample for shard in shards for sample in _samples_of(shard)):
        missing = [what for what, kinds in PARTS.items() if not any(kind in sample.files for kind in kinds)]
        if missing:
            left_out.append(f"{sample.shard.name}: {sample.name} has no {missing[0]}")
            continue
        samples.append(sample)
        # Last bytes, where a png has its checksum; reading all may take hours.
        ends = [(kind, size, sample.read(kind, TAIL)) for kind, (_, size) in sorted(sample.files.items())]
        digest.update(repr((sample.shard.name, sample.name, ends)).encode())
    if not samples:
        raise SourceError(f"{path}: no sample of image, depth and calibration{f' ({left_out[0]})' if left_out else ''}")
    warn_of(left_out, f"{path}: {len(left_out)} samples left out")
    samples = samples[:max_frames]
    return DepthFolder(path.stem, ShardedViews(samples, width), tuple(left_out), digest.hexdigest())


def write_shards(views: Iterable[View], out: Path, name: str, per_shard: int = PER_SHARD) -> list[Path]:
    """Write views as shards ``NAME-000000.tar`` and so on; each file whole or not at all.

    Args:
        views: Undistorted; depth beyond 65 m is lost.
        out: Folder, made when missing.
        name: Beginning of file and sample names, without a dot.
        per_shard: Samples in a file.

    Raises:
        OSError: If a file cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    rest, first, written = iter(views), 0, list[Path]()
    while batch := list(islice(rest, per_shard)):
        written.append(_write(batch, out, name, first))
        first += len(batch)
    return written


def _samples_of(shard: Path) -> list[_Sample]:
    """Samples in order; WebDataset keeps the files of one beside each other."""
    samples: list[_Sample] = []
    try:
        size = shard.stat().st_size
        with open_plain(shard) as opened, tarfile.open(fileobj=opened, mode="r:") as tar:
            for member in tar:
                if not member.isfile():
                    continue
                if member.offset_data + member.size > size:
                    raise SourceError(f"{shard}: is cut off in {member.name}")
                folder, _, file = member.name.rpartition("/")
                stem, _, extension = file.partition(".")
                name = f"{folder}/{stem}" if folder else stem
                if not samples or samples[-1].name != name:
                    samples.append(_Sample(shard, name, {}))
                samples[-1].files[extension.lower()] = member.offset_data, member.size
    except (OSError, tarfile.TarError) as error:
        raise SourceError(
            f"{shard}: no tar file that can be read in place ({error}); compressed ones: gunzip"
        ) from error
    return samples


def _decoded(sample: _Sample) -> View:
    image_kind, depth_kind = (next(k for k in kinds if k in sample.files) for kinds in (IMAGES, DEPTHS))
    record = json.loads(sample.read("json"))
    image = decode(sample.read(image_kind), image_kind, cv2.IMREAD_COLOR)
    content = sample.read(depth_kind)
    if depth_kind == "depth.npy":
        depth = np.load(io.BytesIO(content), allow_pickle=False).astype(np.float32)
    else:
        stored = decode(content, depth_kind, cv2.IMREAD_UNCHANGED)
        per_m = np.float32(record.get("depth_per_m", DEPTH_PER_M))
        if stored.dtype != np.uint16 or per_m <= 0:
            raise ValueError("depth.png: no 16-bit image")
        depth = stored.astype(np.float32) / per_m
    if depth.shape != image.shape[:2]:
        raise ValueError(f"depth {depth.shape[::-1]} of an image {image.shape[1::-1]}")
    fx, fy, cx, cy = (float(record[name]) for name in ("fx", "fy", "cx", "cy"))
    height, width = image.shape[:2]
    allowed = FOCAL_RANGE[0] * width <= min(fx, fy) and max(fx, fy) <= FOCAL_RANGE[1] * width
    if not (allowed and -width <= cx <= 2 * width and -height <= cy <= 2 * height):
        raise ValueError("fx, fy, cx, cy are not a calibration")
    depth_m = np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0.0))
    return View(np.asarray(image, np.uint8), depth_m, np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]))


def _write(views: Sequence[View], out: Path, name: str, first: int) -> Path:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as tar:
        for number, view in enumerate(views, start=first):
            (fx, _, cx), (_, fy, cy) = view.K[:2].tolist()
            stored = np.clip(np.rint(view.depth_m * DEPTH_PER_M), 0, 65535).astype(np.uint16)
            record = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "depth_per_m": DEPTH_PER_M}
            contents = {"png": _png(view.image), "depth.png": _png(stored), "json": json.dumps(record).encode()}
            for extension, content in contents.items():
                entry = tarfile.TarInfo(f"{name}-{number:06d}.{extension}")
                entry.size = len(content)
                tar.addfile(entry, io.BytesIO(content))
    path = out / f"{name}-{first:06d}.tar"
    write_atomically(path, lambda file: file.write(buffer.getbuffer()))
    return path


def _png(image: NDArray[np.uint8] | NDArray[np.uint16]) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+", type=Path, help="recordings with depth")
    parser.add_argument("--out", type=Path, required=True, help="folder for the tar files")
    parser.add_argument("--width", type=int, default=400, help="images are reduced to this width [px]")
    args = parser.parse_args()
    for recording in args.recordings:
        folder = load_depth_folder(recording, args.width)
        written = write_shards(folder.views, args.out, folder.name.replace(".", "_"))
        print(f"{recording}: {len(folder.views)} samples in {len(written)} files")  # noqa: T201 - this is a command


if __name__ == "__main__":
    main()
