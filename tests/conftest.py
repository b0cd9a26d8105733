"""Fixtures that every test folder shares."""

import os
import zlib
from pathlib import Path

import numpy as np
import pytest


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    """Generator seeded from the test's name: the same numbers whatever runs before it."""
    return np.random.default_rng(zlib.crc32(request.node.name.encode()))


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of the recordings, from the environment variable EDGESLAM_DATA; mark the test ``data``."""
    folder = os.environ.get("EDGESLAM_DATA", "")
    if not folder:
        pytest.skip("EDGESLAM_DATA is not set: no recordings to test on")
    if not Path(folder).is_dir():
        pytest.skip(f"EDGESLAM_DATA={folder} is not a folder")
    return Path(folder)
