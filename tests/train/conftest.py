"""Training of tiny networks."""

import pytest
import torch
from posed_run import write_run

from edgeslam_torch.train import callbacks


@pytest.fixture(scope="session", autouse=True)
def one_thread():
    """Several may add up in another order each time, and a resumed training is compared to the last bit."""
    torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch):
    """In TensorBoard: writing them would take longer than the training."""
    monkeypatch.setattr(callbacks, "PICTURE_SIZE", (80, 60))


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory):
    """A perfect run on a rendered recording; not to be changed."""
    return write_run(tmp_path_factory.mktemp("flight"))
