"""Where files are kept that a run makes once, or that were downloaded."""

import os
from pathlib import Path


def cache_folder() -> Path:
    """``EDGESLAM_CACHE``, else ``$XDG_CACHE_HOME/edgeslam``, else ``~/.cache/edgeslam``."""
    given = os.environ.get("EDGESLAM_CACHE")
    if given:
        return Path(given).expanduser()
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "edgeslam"
