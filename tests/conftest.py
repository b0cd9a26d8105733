"""Fixtures that every test folder shares."""

import gc
import os
import signal
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, settings

# No deadline: how long one case takes says something about what else the machine does, not about the code. What a test
# leaves in its folder, the next case overwrites.
settings.register_profile(
    "edgeslam", max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
settings.load_profile("edgeslam")


def pytest_configure(config):
    """Hear signals that whoever started us ignores, as shells do for what runs in the background.

    The programs under test would inherit that, and keep ignoring it, as under `nohup`.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for name in ("SIGTERM", "SIGHUP", "SIGQUIT"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_DFL)
    gc.disable()  # loading torch and a thousand modules makes no garbage


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config, items):
    """Each process that shares the tests begins with slow ones and ends with short ones, which others can take over."""
    processes = getattr(config, "workerinput", {}).get("workercount", 1)
    slow = [item for item in items if item.get_closest_marker("slow")]
    files = list(dict.fromkeys(item.path for item in slow))
    rest = [item for item in items if not item.get_closest_marker("slow")]
    in_order, total = [], len(items)
    for k in range(processes):
        in_order += [item for item in slow if files.index(item.path) % processes == k]
        count = max(0, total * (k + 1) // processes - len(in_order))
        in_order += rest[:count]
        rest = rest[count:]
    items[:] = in_order + rest


def pytest_collection_finish():
    """What is loaded stays: the collector need not look at it again and again."""
    gc.freeze()
    gc.enable()


@pytest.fixture
def rng(request):
    """Generator seeded from the test's name: the same numbers whatever runs before it."""
    return np.random.default_rng(zlib.crc32(request.node.name.encode()))


@pytest.fixture(scope="session")
def data_dir():
    """Folder of the recordings, from the environment variable EDGESLAM_DATA; mark the test ``data``."""
    folder = os.environ.get("EDGESLAM_DATA", "")
    if not folder:
        pytest.skip("EDGESLAM_DATA is not set: no recordings to test on")
    if not Path(folder).is_dir():
        pytest.skip(f"EDGESLAM_DATA={folder} is not a folder")
    return Path(folder)


@pytest.fixture
def write_images(rng):
    """Function that writes small random grey pictures: ``write_images(folder, names, size=(64, 48))``."""

    def write(folder, names, size=(64, 48)):
        folder.mkdir(parents=True, exist_ok=True)
        paths = [folder / name for name in names]
        for path in paths:
            path.parent.mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(path), rng.integers(0, 256, (size[1], size[0]), dtype=np.uint8))
        return paths

    return write


@pytest.fixture
def write_tum(write_images):
    """Function that writes a TUM-layout folder with images at 10 Hz: ``write_tum(folder, count)``."""

    def write(folder, count, size=(64, 48)):
        stamps = [100.0 + 0.1 * i for i in range(count)]
        names = [f"rgb/{stamp:.6f}.png" for stamp in stamps]
        write_images(folder, names, size)
        lines = [f"{stamp:.6f} {name}" for stamp, name in zip(stamps, names, strict=True)]
        (folder / "rgb.txt").write_text("# stamp file\n" + "\n".join(lines) + "\n")
        return folder

    return write
