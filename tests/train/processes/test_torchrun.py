"""``edgeslam finetune`` in two processes, as docs/guides/training.md starts it."""

import os
import signal
import socket
import subprocess
import sys
import time

import pytest
import torch
from small_depth import RUNS, narrow_fastdepth

from edgeslam_torch.models.checkpoint import load_checkpoint, save_checkpoint
from edgeslam_torch.train.state import saved_step

pytestmark = pytest.mark.slow

TORCHRUN = (sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2")
MODULE = ("-m", "edgeslam_torch.cli")
STEPS = 120
"""The state is saved eight times; a process is killed soon after the first."""
ENVIRONMENT = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}


@pytest.fixture
def weights(tmp_path):
    save_checkpoint(narrow_fastdepth(), RUNS, tmp_path / "w.safetensors")
    return tmp_path / "w.safetensors"


def words(run_folder, weights, out, steps):
    given = (run_folder, "--weights", weights, "--out", out, "--steps", steps, "--batch", 4, "--lr", 0.01)
    return ["finetune", *map(str, given)]


def run(*command):
    return subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, timeout=280, check=False)


def two_workers(words):
    """The processes that torchrun would start, without torchrun, which ends one when the other ends."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    group = ENVIRONMENT | {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    command = [sys.executable, *MODULE, *words]
    return [
        subprocess.Popen(command, env=group | {"RANK": str(rank)}, stderr=subprocess.PIPE, text=True)
        for rank in range(2)
    ]


def assert_close(first, second):
    """The same images and terms, added up in another order, stored in half precision."""
    one, other = (load_checkpoint(p)[0].state_dict() for p in (first, second))
    for name, value in one.items():
        torch.testing.assert_close(other[name], value, rtol=4e-3, atol=1e-3, msg=name)


def test_two_processes_give_the_weights_of_one(run_folder, weights, tmp_path):
    alone, together = tmp_path / "alone", tmp_path / "together"
    assert run(sys.executable, *MODULE, *words(run_folder, weights, alone, 8)).returncode == 0
    done = run(*TORCHRUN, *MODULE, *words(run_folder, weights, together, 8))
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("| before |") == 1, "the first process alone reports"
    for name in ("weights.safetensors", "final.safetensors"):
        assert_close(alone / name, together / name)
    assert len(list((together / "teacher").rglob("swept_*.npy"))) == 11


@pytest.mark.parametrize("killed", [0, 1])
def test_killed_process_ends_the_other_clearly_and_training_goes_on(run_folder, weights, tmp_path, killed):
    out = tmp_path / "out"
    workers = two_workers(words(run_folder, weights, out, STEPS))
    try:
        deadline = time.monotonic() + 200
        while not (out / "last.pt").is_file() and time.monotonic() < deadline:
            time.sleep(0.01)
        workers[killed].send_signal(signal.SIGKILL)
        _, stderr = workers[1 - killed].communicate(timeout=60)
    finally:
        for worker in workers:
            worker.kill()
            worker.communicate()
    assert workers[1 - killed].returncode == 1, stderr
    errors = [line for line in stderr.splitlines() if "error" in line]
    assert len(errors) == 1
    assert "another process of this training ended" in errors[0]
    step = saved_step(out / "last.pt")
    assert 0 < step < STEPS
    if killed == 1:  # which of them it was makes no difference to what is saved
        return
    done = run(*TORCHRUN, *MODULE, *words(run_folder, weights, out, STEPS))
    assert done.returncode == 0, done.stderr
    assert f"resumes after step {step}" in done.stdout
    assert saved_step(out / "last.pt") == STEPS


def test_more_processes_than_images_are_refused(run_folder, weights, tmp_path):
    workers = two_workers([*words(run_folder, weights, tmp_path / "out", 4), "--batch", "1"])
    errors = [worker.communicate(timeout=280)[1] for worker in workers]
    assert [worker.returncode for worker in workers] == [1, 1]
    assert "2 processes for a batch of 1" in errors[0]
