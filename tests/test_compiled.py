"""Compiled loops: with a cache, without one, by two processes at once."""

import ast
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numba
import pytest

from edgeslam_torch import compiled as module

PACKAGE = Path(module.__file__).parent
COMPILED = sorted(
    path for path in PACKAGE.rglob("*.py") if "edgeslam_torch.compiled import compiled" in path.read_text("utf-8")
)
RHO = "from edgeslam_torch.optim.kernels.normal_equations import rho; print(rho(16.0, 2.0))"


def test_without_a_place_for_a_cache_every_process_compiles(monkeypatch):
    def njit(cache=False, **settings):
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return numba.njit(**settings)

    monkeypatch.setattr(module, "numba", SimpleNamespace(njit=njit))
    assert module.compiled()(lambda x: 2.0 * x)(1.5) == 3.0


FLIGHT = """
from rendered import CAMERA, panels
from edgeslam_torch import EdgeSlam, compiled

slam = EdgeSlam(CAMERA, realtime={realtime})
assert all(loops.overloads for loops, _ in compiled._TYPED)
for frame in panels().frames:
    slam.step(frame)
slam.finish()
print([loops.py_func.__name__ for loops, _ in compiled._TYPED if len(loops.overloads) > 1])
"""


@pytest.mark.slow
@pytest.mark.parametrize("realtime", [True, False])
def test_nothing_is_compiled_once_the_system_is_made(realtime):
    """The camera does not wait for it, nor does it count in the times of a first run."""
    path = os.pathsep.join([str(Path(__file__).parent / "helpers"), *sys.path])
    environment = os.environ | {"PYTHONPATH": path}
    command = [sys.executable, "-c", FLIGHT.format(realtime=realtime)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.stdout == "[]\n", done.stderr


@pytest.mark.slow
def test_two_processes_at_once_share_a_cache(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", RHO]
    both = [subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    assert [p.communicate()[0] for p in both] == ["(12.0, 0.5)\n"] * 2
    assert list(tmp_path.rglob("*.nbi"))
    again = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert again.stdout == "(12.0, 0.5)\n"
    assert "compiling" not in again.stderr


@pytest.mark.parametrize("path", COMPILED, ids=lambda path: path.stem)
def test_a_compiled_function_calls_only_those_of_its_own_file(path):
    """The cache does not notice changes of other files."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    imported = {
        alias.asname or alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("edgeslam_torch")
        for alias in node.names
    }
    loops = [
        node
        for node in tree.body
        if isinstance(node, ast.FunctionDef)
        and any(isinstance(d, ast.Call) and getattr(d.func, "id", "") == "compiled" for d in node.decorator_list)
    ]
    assert loops
    called = {
        node.func.id
        for loop in loops
        for node in ast.walk(loop)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    }
    assert not called & (imported - {"compiled"})
