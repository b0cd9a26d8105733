"""``python -m edgeslam_torch.eval.judge.run_cell FOLDER``: run and judge the cell that ``FOLDER/cell.json`` describes.

In a separate process, so that failures are isolated and memory and CPU time are measurable.
"""

import json
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch.config import SlamConfig
from edgeslam_torch.errors import EdgeSlamError
from edgeslam_torch.eval.benchmark.machine_speed import orb_pass_ms
from edgeslam_torch.eval.inputs.dataset import interpolate, open_dataset
from edgeslam_torch.eval.inputs.trajectory_files import Trajectory, write_tum
from edgeslam_torch.eval.judge import flights, second_flight, sources
from edgeslam_torch.eval.judge.cells import BACKWARDS, CUT, CUT_FRAMES, HALF, KIDNAP, SECOND_FLIGHT, VARIANTS, Cell
from edgeslam_torch.eval.judge.runner import CELL, RESULT
from edgeslam_torch.eval.judge.score import Truth, score
from edgeslam_torch.eval.judge.telemetry.simulated_telemetry import KINDS, Drawn
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.files.config_file import load_config
from edgeslam_torch.jobs.watched import end_with_parent
from edgeslam_torch.readers.layouts import read_sequence
from edgeslam_torch.readers.source import Recording, open_source
from edgeslam_torch.run import run, settle_camera
from edgeslam_torch.synthetic.flights.courses import COURSES, RATE_HZ
from edgeslam_torch.types import FloatArray

RUN = "run"


def main(folder: Path) -> int:
    """Write ``result.json`` to the folder; on failure the last line on stderr gives the reason."""
    begin_s = time.monotonic()
    spec: dict[str, Any] = json.loads((folder / CELL).read_text(encoding="utf-8"))
    cell = Cell(**spec["cell"])
    config = load_config(replace(SlamConfig(), seed=cell.seed), None, spec["overrides"])
    begin_cpu_s = time.process_time()
    before_ms = orb_pass_ms()
    timing_s = time.process_time() - begin_cpu_s
    try:
        source, truth = _opened(cell, folder, Path(spec["flights"]))
        if spec["max_frames"] is not None:
            source = sources.first_frames(source, spec["max_frames"])
        if cell.variant == SECOND_FLIGHT:
            first, first_truth = _first_flight(cell, Path(spec["flights"]))
            second_flight.fly_first(first, folder, config)
            result = second_flight.fly_second(source, folder / RUN, folder, config)
        else:
            settle_camera(source)
            result = run(source, folder / RUN, config)
        cpu_ms = 1e3 * (time.process_time() - timing_s) / max(result.summary["frames"], 1)
        orb_ms = (before_ms + orb_pass_ms()) / 2
        if result.interrupted or result.failure is not None:
            sys.stderr.write(f"{result.failure or 'interrupted'}\n")
            return 1
        figures, notes = score(folder / RUN, truth)
        figures |= {"cpu_ms": cpu_ms, "orb_ms": orb_ms, "cpu_orb": cpu_ms / orb_ms}
        if cell.variant == SECOND_FLIGHT:
            figures |= second_flight.compared(folder / RUN, truth, folder / second_flight.FIRST, first_truth)
    except EdgeSlamError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    figures["took_s"] = time.monotonic() - begin_s
    write_text(folder / RESULT, json.dumps({"key": spec["key"], "figures": figures, "notes": notes}, indent=1) + "\n")
    return 0


def _opened(cell: Cell, folder: Path, flights_root: Path) -> tuple[Recording, Truth]:
    """The cell's source and what its run is compared with."""
    if cell.nothing:
        return flights.nothing_to_see(cell.nothing, cell.seed), Truth(None)
    if cell.variant == CUT:
        here, there = (flights.flight_folder(flights_root, cell.course, cell.seed + after) for after in (0, 1))
        return sources.followed_by(_recording(here), _recording(there), CUT_FRAMES, RATE_HZ), Truth(None)
    if cell.course:
        place = flights.flight_folder(flights_root, cell.course, cell.seed, int(cell.variant == SECOND_FLIGHT))
        return _recording(place), Truth(place, surfaces=lambda p: _distances(cell, p))
    place = Path(cell.folder)
    source = _recording(place)
    if cell.variant == "kidnap":
        return _kidnapped(source, place, folder / "groundtruth.txt")
    if cell.variant == BACKWARDS:
        return _backwards(source, place, folder / "groundtruth.txt")
    if cell.variant == SECOND_FLIGHT:
        return sources.start_at(source, HALF), Truth(place)
    dataset = open_dataset(place)
    if cell.telemetry:
        drawn = Drawn(dataset.truth, dataset.frame_stamps_s, cell.seed)
        return replace(source, telemetry=KINDS[cell.telemetry](drawn)), Truth(place)
    truth = Truth(place, place if dataset.depth is not None else None)
    return VARIANTS[cell.variant].applied_to(source, cell.seed) if cell.variant else source, truth


def _first_flight(cell: Cell, flights_root: Path) -> tuple[Recording, Truth]:
    """Source of the flight whose map the cell's flight starts with."""
    if cell.course:
        place = flights.flight_folder(flights_root, cell.course, cell.seed)
        return _recording(place), Truth(place)
    return sources.first_frames(_recording(Path(cell.folder)), HALF), Truth(Path(cell.folder))


def _recording(place: Path) -> Recording:
    source = open_source(place)
    assert isinstance(source, Recording)
    return source


def _distances(cell: Cell, p_w: FloatArray) -> FloatArray:
    """Distances ``(N,)`` of points to the surfaces of a simulated flight's world, built anew."""
    return COURSES[cell.course].world(np.random.default_rng(cell.seed)).distance_to_surface(p_w)


def _kidnapped(source: Recording, place: Path, truth_file: Path) -> tuple[Recording, Truth]:
    """The cut recording, with its ground truth cut the same way into a file."""
    dataset = open_dataset(place)
    plan = sources.Cut(KIDNAP, dataset.frame_stamps_s)
    T_w_c, known = interpolate(dataset.truth, dataset.frame_stamps_s[plan.originals])
    write_tum(Trajectory(plan.new_stamps_s[known], T_w_c[known]), truth_file)
    return sources.cut(source, plan), Truth(truth_file)


def _backwards(source: Recording, place: Path, truth_file: Path) -> tuple[Recording, Truth]:
    """The reversed recording, with its ground truth reversed the same way into a file."""
    sequence = read_sequence(place)
    assert sequence is not None, "a recording with truth has a layout"
    stamps_s = np.array([entry.stamp_s for entry in sequence.images])
    T_w_c, known = interpolate(open_dataset(place).truth, stamps_s)
    turned = sources.mirrored_stamps_s(stamps_s)[known]
    write_tum(Trajectory(turned[::-1], T_w_c[known][::-1]), truth_file)
    return sources.backwards(source, sequence.images), Truth(truth_file)


if __name__ == "__main__":
    end_with_parent()
    sys.exit(main(Path(sys.argv[1])))
