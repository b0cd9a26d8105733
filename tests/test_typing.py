"""What a type checker and an editor see of the public names."""

import importlib
import inspect
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PUBLIC = ("edgeslam_torch", "edgeslam_torch.losses", "edgeslam_torch.models", "edgeslam_torch.train")
WITHOUT_SAYING = re.compile(r"numpy\.ndarray\[[^()]*?\]\]+|dict\[str, Any\]")
"""numpy's arrays, which have no shape for the type checker, and records as JSON has them."""

USER = """
import torch
from edgeslam_torch import Camera, EdgeSlam, SlamConfig, open_source
from edgeslam_torch.losses import CycleLoss, MaskedL1, Residuals, TotalLoss
from edgeslam_torch.train import Drawn, Hooks, TrainState


class Mine(Hooks):
    def on_losses(self, state: TrainState, drawn: Drawn) -> None:
        value: torch.Tensor = MaskedL1()(drawn.predicted.log_depth, drawn.batch["log_depth"], drawn.batch["mask"])
        drawn.losses["mine"] = value

    def on_step(self, state: TrainState, losses: dict[str, int]) -> None:  # type: ignore[override]
        state.stop = 3  # type: ignore[assignment]


def scale(x: torch.Tensor) -> Residuals:
    CycleLoss()(x, x, x)  # type: ignore[call-arg]
    MaskedL1()("depth", x, x)  # type: ignore[arg-type]
    TotalLoss([1.0])  # type: ignore[arg-type]
    total: float = TotalLoss({"mine": 1.0})({"mine": x})  # type: ignore[assignment]
    return CycleLoss().residuals(x, x, x, x, x)


def run(path: str) -> EdgeSlam:
    slam = EdgeSlam(Camera(640, 480, 500.0, 500.0, 319.5, 239.5), SlamConfig())
    for frame, telemetry in open_source(path).steps():
        slam.step(frame, telemetry).status.name.lower()
    slam.stop()  # type: ignore[attr-defined]
    return slam
"""


@pytest.mark.parametrize("package", PUBLIC)
def test_every_public_name_is_listed_and_there(package):
    module = importlib.import_module(package)
    assert set(module.__all__) <= set(dir(module))
    assert [name for name in module.__all__ if not hasattr(module, name)] == []
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        module.nothing  # noqa: B018


def questions() -> Iterator[str]:
    """``reveal_type`` of every public name, and of every method of the classes among them."""
    for package in PUBLIC:
        yield f"import {package}"
        module = importlib.import_module(package)
        for name in module.__all__:
            what = getattr(module, name)
            yield f"reveal_type({package}.{name})"
            if inspect.isclass(what):
                methods = [n for n in vars(what) if not n.startswith("_") and callable(getattr(what, n))]
                yield from (f"reveal_type({package}.{name}.{n})" for n in methods)


@pytest.mark.slow
def test_users_project_is_checked_strictly_and_sees_no_any(tmp_path):
    (tmp_path / "project.py").write_text(USER)
    (tmp_path / "names.py").write_text("\n".join(questions()) + "\n")
    (tmp_path / "mypy.ini").write_text("[mypy]\nstrict = True\nuntyped_calls_exclude = torch\n")
    examples = [ROOT / "examples" / name for name in ("training_hooks.py", "own_training_loop.py")]
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--cache-dir", str(tmp_path / "cache"), "project.py", "names.py", *examples],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    said = done.stdout.splitlines()
    assert done.returncode == 0, [line for line in said if "Revealed" not in line]
    revealed = [line.split("Revealed type is ")[1] for line in said if "Revealed type is " in line]
    assert len(revealed) > 150
    assert [line for line in revealed if re.search(r"\bAny\b", WITHOUT_SAYING.sub("", line))] == []
