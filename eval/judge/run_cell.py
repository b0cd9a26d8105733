"""A cell's run and its figures: what the process of a cell does."""

import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch.config import SlamConfig
from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.experiment.conditions import orb_pass_ms
from edgeslam_torch.eval.inputs.dataset import interpolate, open_dataset
from edgeslam_torch.eval.inputs.trajectory_files import Trajectory, write_tum
from edgeslam_torch.eval.judge import flights, sources
from edgeslam_torch.eval.judge.cells import BACKWARDS, CASES, CUT, KIDNAP, SECOND_FLIGHT, VARIANTS, Cell
from edgeslam_torch.eval.judge.score import Truth, score
from edgeslam_torch.eval.judge.simulated_imu import IMU_KINDS, RECORDED
from edgeslam_torch.eval.judge.simulated_telemetry import KINDS, Drawn
from edgeslam_torch.files.config_file import load_config
from edgeslam_torch.readers.layouts import read_sequence
from edgeslam_torch.readers.source import Recording, open_source
from edgeslam_torch.run import AtlasFiles, RunResult, run, settle_camera
from edgeslam_torch.synthetic.flights.courses import COURSES, RATE_HZ

RUN, FIRST, ATLAS = "run", "first", "first.atlas"
"""In a cell's folder: its run; of two flights, the first one's run and map."""
CUT_FRAMES = 160
"""Of either world."""
_NEVER_S = 1e3
"""Stands for a map that is never recognised."""


def run_cell(case: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Figures and notes of the cell that ``case`` describes; its run is left in ``folder``.

    Raises:
        EdgeSlamError: If it cannot be run or evaluated.
    """
    begin_s = time.monotonic()
    cell = Cell(**case["cell"])
    config = load_config(replace(SlamConfig(), seed=cell.seed), None, case["overrides"])
    begin_cpu_s = time.process_time()
    before_ms = orb_pass_ms()
    timing_s = time.process_time() - begin_cpu_s
    source, truth = opened(cell, folder, Path(case["flights"]))
    source = replace(source, max_frames=case["max_frames"])
    earlier = AtlasFiles()
    if cell.variant == SECOND_FLIGHT:
        from edgeslam_torch.atlas.atlas_file import read_atlas

        first, first_truth = opened(replace(cell, variant=""), folder, Path(case["flights"]))
        first = replace(first, max_frames=CASES[SECOND_FLIGHT].get(cell.base))
        _flown(first, folder / FIRST, config, AtlasFiles(save=folder / ATLAS))
        earlier = AtlasFiles(load=read_atlas(folder / ATLAS))
    result = _flown(source, folder / RUN, config, earlier)
    cpu_ms = 1e3 * (time.process_time() - timing_s) / max(result.summary["frames"], 1)
    orb_ms = (before_ms + orb_pass_ms()) / 2
    figures, notes = score(folder / RUN, truth)
    figures |= {"cpu_ms": cpu_ms, "orb_ms": orb_ms, "cpu_orb": cpu_ms / orb_ms}
    if cell.variant == SECOND_FLIGHT:
        first_scale = score(folder / FIRST, Truth(first_truth.poses))[0].get("scale_sim3")
        figures |= _beside_first(result, figures.get("scale_sim3"), first_scale)
    figures["took_s"] = time.monotonic() - begin_s
    return {"figures": figures, "notes": notes}


def _beside_first(result: RunResult, scale: float | None, first_scale: float | None) -> dict[str, float | None]:
    """Figures of a flight that started with the map of another.

    Returns:
        ``placed_after_s`` until the first frame in that map, ``placed`` share of frames in it, and ``metres_off``
        absolute log of the ratio of the true lengths of the two flights' units.
    """
    found = result.summary["atlas"]
    return {
        "placed_after_s": _NEVER_S if found["found_after_s"] is None else found["found_after_s"],
        "placed": found["frames_placed"] / max(result.summary["frames"], 1),
        "metres_off": abs(math.log(scale / first_scale)) if scale and first_scale else None,
    }


def _flown(source: Recording, out: Path, config: SlamConfig, atlas: AtlasFiles) -> RunResult:
    settle_camera(source)
    result = run(source, out, config, atlas=atlas)
    if result.interrupted or result.failure is not None:
        raise EvaluationError(result.failure or "interrupted")
    return result


def opened(cell: Cell, folder: Path, flights_root: Path) -> tuple[Recording, Truth]:
    """The cell's source and what its run is compared with."""
    if cell.nothing:
        return flights.nothing_to_see(cell.nothing, cell.seed), Truth(None)
    if cell.variant == CUT:
        here, there = (flights.flight_folder(flights_root, cell.course, cell.seed + after) for after in (0, 1))
        return sources.followed_by(_recording(here), _recording(there), CUT_FRAMES, RATE_HZ), Truth(None)
    if cell.course:
        place = flights.flight_folder(flights_root, cell.course, cell.seed, int(cell.variant == SECOND_FLIGHT))
        world = COURSES[cell.course].world
        return _with_imu(cell, _recording(place), place), Truth(
            place, surfaces=lambda p_w: world(np.random.default_rng(cell.seed)).distance_to_surface(p_w)
        )
    place = Path(cell.folder)
    source = _recording(place)
    if cell.imu == RECORDED:
        return source.part(cell.seed, 1), Truth(place)
    source = replace(source, telemetry=[], imu=None, imu_readings=None)  # images alone
    if cell.variant in (KIDNAP, BACKWARDS):
        return _reordered(cell, source, folder / "groundtruth.txt")
    if cell.variant == SECOND_FLIGHT:
        return source.part(CASES[SECOND_FLIGHT][cell.base], 1), Truth(place)
    dataset = open_dataset(place)
    if cell.telemetry:
        drawn = Drawn(dataset.truth, dataset.frame_stamps_s, cell.seed)
        return replace(source, telemetry=KINDS[cell.telemetry](drawn)), Truth(place)
    source = _with_imu(cell, source, place)
    truth = Truth(place, dataset.depth is not None)
    return VARIANTS[cell.variant].applied_to(source, cell.seed) if cell.variant else source, truth


def _with_imu(cell: Cell, source: Recording, place: Path) -> Recording:
    """The source with the cell's simulated IMU in place of all its sensors."""
    if not cell.imu:
        return source
    dataset = open_dataset(place)
    model, readings = IMU_KINDS[cell.imu](Drawn(dataset.truth, dataset.frame_stamps_s, cell.seed))
    return replace(source, telemetry=[], imu=model, imu_readings=readings)


def _recording(place: Path) -> Recording:
    source = open_source(place)
    assert isinstance(source, Recording)
    return source


def _reordered(cell: Cell, source: Recording, truth_file: Path) -> tuple[Recording, Truth]:
    """The images in another order, with their ground truth in the same order in a file."""
    sequence = read_sequence(Path(cell.folder))
    assert sequence is not None, "a recording with truth has a layout"
    stamps_s = np.array([entry.stamp_s for entry in sequence.images])
    if cell.variant == BACKWARDS:
        order, played_s = sources.backwards(stamps_s)
    else:
        order, played_s = sources.cut(stamps_s, CASES[KIDNAP][cell.base])
    T_w_c, known = interpolate(open_dataset(Path(cell.folder)).truth, stamps_s[order])
    write_tum(Trajectory(played_s[known], T_w_c[known]), truth_file)
    return sources.reordered(source, sequence.images, order, played_s), Truth(truth_file)
