"""Whether files are still those of before, without reading them."""

import hashlib
from pathlib import Path


def signature(path: Path, excluded: Path | None = None) -> str:
    """Changes when a file is added, taken away, changed or renamed; reads none of them.

    Args:
        path: A file, or a folder with all that is in it.
        excluded: A folder that does not count although it may lie in ``path``.

    Raises:
        OSError: If there is nothing at ``path``.
    """
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    digest = hashlib.sha256()
    for file in files:
        if excluded is None or not file.is_relative_to(excluded):
            state = file.stat()
            digest.update(f"{file.relative_to(path)} {state.st_size} {state.st_mtime_ns}\n".encode())
    return digest.hexdigest()
