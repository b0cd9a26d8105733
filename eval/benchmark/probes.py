"""Solver and depth network alone, timed repeatedly during a benchmark.

Functions here run in the process of `machine_speed.MachineSpeed`, each call right after the reference work, so that
every figure has as many values as the benchmark has pauses between runs.
"""

import statistics
import tempfile
import time
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch.errors import EdgeSlamError
from edgeslam_torch.eval.benchmark.machine_speed import reference

_DEPTH_REPEATS = 10
_ITERATIONS = 5


def reference_alone() -> dict[str, Any]:
    """One bout without solver and network."""
    return {"reference": reference()}


def bout() -> dict[str, Any]:
    """One bout: reference work, solver, depth network."""
    return {"reference": reference(), "solver": _guarded(_solver), "depth": _guarded(_depth)}


def gather(bouts: list[dict[str, Any]]) -> dict[str, Any]:
    """Bouts as the record holds them: a list of values per figure, texts once.

    A part that failed once is not measured: its list would not match the references'.
    """
    out: dict[str, Any] = {"references": [b["reference"] for b in bouts]}
    for part in ("solver", "depth"):
        found = [b[part] for b in bouts if part in b]
        if not found:
            continue
        failed = next((f for f in found if "not measured" in f), None)
        texts = {k: v for k, v in found[0].items() if isinstance(v, str)}
        out[part] = failed or texts | {k: [f[k] for f in found] for k in found[0] if k not in texts}
    return out


def _guarded(measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """A measurement that an installation cannot make (no weights, no onnx) is skipped with a reason."""
    try:
        return measure()
    except (EdgeSlamError, ImportError, RuntimeError, OSError) as error:
        return {"not measured": f"{type(error).__name__}: {' '.join(str(error).split())[:120]}"}


@lru_cache(maxsize=1)
def _problems() -> tuple[Any, Any]:
    """The seeded window, complete and with points only, solved once to warm caches."""
    from edgeslam_torch.eval.benchmark.windows import points_only, seeded_window
    from edgeslam_torch.optim.local_ba import refine_window

    window = seeded_window()
    problems = window.problem, points_only(window).problem
    for problem in problems:
        refine_window(problem)
    return problems


def _solver() -> dict[str, Any]:
    """CPU milliseconds of the window, of its points alone, and of gtsam on those points when it is installed."""
    from edgeslam_torch.eval.benchmark.windows import refine_with_gtsam
    from edgeslam_torch.optim.local_ba import refine_window
    from edgeslam_torch.optim.problem import LmConfig

    config = LmConfig(max_iterations=_ITERATIONS, cost_tolerance=0.0, diagnostics=False)
    out: dict[str, Any] = {}
    for name, problem in zip(("all terms", "points"), _problems(), strict=True):
        start = time.process_time()
        refine_window(problem, config)
        out[name] = 1e3 * (time.process_time() - start)
    try:
        out["points, gtsam"] = 1e3 * refine_with_gtsam(_problems()[0], _ITERATIONS)[0]
    except ModuleNotFoundError:
        out["beside"] = "gtsam is not installed"
    return out


@lru_cache(maxsize=1)
def _sessions() -> tuple[str, dict[str, Callable[[], object]]]:
    """Size of the shipped network's input, and a call of its float32 and int8 forms in onnxruntime, one thread."""
    import onnxruntime

    from edgeslam_torch.models.checkpoint import load_checkpoint
    from edgeslam_torch.models.onnx.export import ExportOptions, export_onnx
    from edgeslam_torch.models.onnx.quantize import quantize_int8

    network, metadata = load_checkpoint(None)
    height, width = metadata.input_height, metadata.input_width
    rng = np.random.default_rng(0)
    images = [rng.random((1, 3, height, width), dtype=np.float32) for _ in range(8)]
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    calls: dict[str, Callable[[], object]] = {}
    with tempfile.TemporaryDirectory() as folder:
        plain, small = Path(folder) / "float32.onnx", Path(folder) / "int8.onnx"
        export_onnx(network, metadata, plain, ExportOptions(height, width))
        quantize_int8(plain, small, images)
        for name, path in (("fp32", plain), ("int8", small)):
            session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
            feed = {session.get_inputs()[0].name: images[0]}
            calls[name] = partial(session.run, None, feed)
    for call in calls.values():
        call()
    return f"{width}x{height}", calls


def _depth() -> dict[str, Any]:
    """Median milliseconds an image, by the clock."""
    size, calls = _sessions()
    out: dict[str, Any] = {"size": size}
    for name, call in calls.items():
        times = []
        for _ in range(_DEPTH_REPEATS):
            start = time.perf_counter()
            call()
            times.append(1e3 * (time.perf_counter() - start))
        out[name] = statistics.median(times)
    return out
