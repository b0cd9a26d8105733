"""docs/theory/README.md says where each equation runs: every name exists, and is called on a small simulated flight."""

import importlib
import inspect
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import CodeType

import numpy as np
import pytest
from posed_run import write_run

from edgeslam_torch.config import SlamConfig, WindowConfig
from edgeslam_torch.demo import DemoSettings, record
from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.motion import MotionFusion
from edgeslam_torch.eval.inputs.trajectory_files import Trajectory
from edgeslam_torch.eval.metrics.trajectory_error import score_trajectory
from edgeslam_torch.mapping.last_refinement import lm_config, refine_with_edges
from edgeslam_torch.models.fastdepth import FastDepth
from edgeslam_torch.models.record import Metadata
from edgeslam_torch.readers.source import open_source
from edgeslam_torch.slam import EdgeSlam
from edgeslam_torch.synthetic.flights.flight import fly
from edgeslam_torch.synthetic.flights.telemetry import EXACT, simulate
from edgeslam_torch.synthetic.house.world import World
from edgeslam_torch.train.self_supervised import SelfSupervised
from edgeslam_torch.train.signals import Slot
from edgeslam_torch.train.views.posed import load_run

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "theory" / "README.md"
WINDOW = WindowConfig(angle="arms", collinearity="relative")


def rows() -> list[list[str]]:
    """Cells of the tables' rows."""
    lines = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines]


def named() -> list[str]:
    """Dotted names in the order of the page, each once."""
    return list(dict.fromkeys(re.findall(r"`(edgeslam_torch(?:\.\w+)+)`", PAGE.read_text(encoding="utf-8"))))


def resolve(name: str) -> Callable[..., object]:
    """The function that a dotted name means."""
    parts = name.split(".")
    for split in range(len(parts) - 1, 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:split]))
        except ModuleNotFoundError:
            continue
        for part in parts[split:]:
            found = getattr(found, part)
        return inspect.unwrap(found)  # type: ignore[arg-type]
    raise ModuleNotFoundError(name)


def fly_and_map(folder: Path) -> World:
    """Four seconds of the demo flight with all terms of the window, refined once more with the printed cycle."""
    flown = record(folder, DemoSettings(world="corridor", seconds=4.0, rate_hz=10.0, width=320, height=240))
    source = open_source(str(folder))
    slam = EdgeSlam(source.camera, SlamConfig(window=WINDOW))
    for frame in source.frames():
        slam.step(frame)
    slam.finish()
    assert slam.losses()["total"] > 0.0
    refine_with_edges(slam.map, slam.camera, slam.edges, lm_config(WINDOW), replace(WINDOW, cycle="literal"))
    stamps, T_w_c = slam.trajectory()
    score_trajectory(Trajectory(flown.flight.stamps_s, flown.flight.T_w_c), Trajectory(stamps, T_w_c))
    return flown.world


def filter_telemetry(world: World) -> None:
    """10 s of telemetry with the true poses of a flight in a map of half its size."""
    rng = np.random.default_rng(0)
    flight = fly(rng, world, 200, rate_hz=20.0)
    log = simulate(rng, flight.stamps_s, flight.T_w_c, flight.T_b_c, faults=EXACT)
    fusion = MotionFusion(FusionConfig(), flight.T_b_c)
    arrived = sorted(log.samples(), key=lambda sample: sample.stamp_s)
    for stamp, T_w_c in zip(flight.stamps_s, flight.T_w_c, strict=True):
        while arrived and arrived[0].stamp_s <= stamp:
            fusion.add_telemetry([arrived.pop(0)])
        T = T_w_c.copy()
        T[:3, 3] *= 0.5
        fusion.add_visual(float(stamp), T, 0.001, 0.001)
        fusion.predict(float(stamp))


def fine_tune(folder: Path) -> None:
    """One evaluation of the self-supervised losses on a run."""
    metadata = Metadata(input_height=96, input_width=128, focal_px=100.0)
    signal = SelfSupervised([load_run(write_run(folder))], metadata)
    batch = signal.draw([Slot(0, 0, 0)])
    signal.losses(FastDepth(metadata.variant, uncertainty=True).predict(batch["image"]), batch)


@pytest.fixture(scope="module")
def called(tmp_path_factory: pytest.TempPathFactory) -> set[CodeType]:
    """Everything that runs while a flight is mapped, filtered, evaluated and learnt from."""
    seen: set[CodeType] = set()

    def profile(frame: object, event: str, arg: object) -> None:
        if event == "call":
            seen.add(frame.f_code)  # type: ignore[attr-defined]

    root = tmp_path_factory.mktemp("equations")
    before = sys.getprofile()
    sys.setprofile(profile)
    try:
        world = fly_and_map(root / "flight")
        filter_telemetry(world)
        fine_tune(root / "tuned")
    finally:
        sys.setprofile(before)
    return seen


def test_every_equation_of_the_paper_has_a_row() -> None:
    numbers = [int(n) for row in rows() if re.fullmatch(r"[\d, ]+", row[0]) for n in row[0].split(",")]
    assert numbers == list(range(1, 31))


def test_only_what_is_said_to_run_nowhere_has_no_name() -> None:
    empty = [row[0] for row in rows() if re.fullmatch(r"[\d, ]+", row[0]) and "`" not in row[2]]
    assert empty == []


@pytest.mark.parametrize("page", sorted(PAGE.parent.glob("*.md")), ids=lambda path: path.stem)
def test_what_the_theory_names_exists(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for name in re.findall(r"`(edgeslam_torch(?:\.\w+)+)`", text):
        assert resolve(name)
    for path in re.findall(r"`([\w/]+/[\w/]*(?:\.py)?)`", text):
        assert (ROOT / path).exists() or (ROOT / "edgeslam_torch" / path).exists(), path


@pytest.mark.parametrize("name", named())
def test_named_function_is_called(name: str, called: set[CodeType]) -> None:
    ran = resolve(name).__code__ in called  # type: ignore[attr-defined]
    assert ran, f"{name} did not run"
