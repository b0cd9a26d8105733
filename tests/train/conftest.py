"""Training of tiny networks."""

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from posed_run import write_run

from edgeslam_torch.train import callbacks


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Tiny networks gain nothing from more threads, and on a busy machine these wait for one another."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """In TensorBoard: writing them would take longer than the training."""
    monkeypatch.setattr(callbacks, "PICTURE_SIZE", (80, 60))


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A perfect run on a rendered recording; not to be changed."""
    return write_run(tmp_path_factory.mktemp("flight"))
