"""A tracked frame's way through the folders: as docs/architecture.md lists it, never upwards, with few hops."""

import re
import sys
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from types import CodeType, FrameType

import pytest
from layers import LAYERS, TABLE, part_of
from rendered import CAMERA, film, sideways, stairs_world

import edgeslam_torch
from edgeslam_torch.config import DepthConfig, SlamConfig
from edgeslam_torch.slam import EdgeSlam
from edgeslam_torch.types import FrameStatus

HOPS = 51
"""Different calls from one folder into another on a tracked frame's way, without those into `geometry` and `types`."""

CLIMBS = 11
"""Times that the way goes on in a higher row of the table than before, in the order in which it first enters files."""

ROOT = Path(edgeslam_torch.__file__).parent
ROWS = {part: number for number, row in enumerate(LAYERS) for part in row.parts}
Call = tuple[str, str, str]
"""Calling module, called module, called function; all of the package, whatever lies between."""


def module_of(code: CodeType) -> str | None:
    """Full name of the package's module that a function stands in; None for other packages."""
    path = Path(code.co_filename)
    return ".".join(("edgeslam_torch", *path.relative_to(ROOT).with_suffix("").parts)) if ROOT in path.parents else None


def caller_of(frame: FrameType) -> str | None:
    """The nearest module of the package that a call comes from."""
    above = frame.f_back
    while above is not None:
        module = module_of(above.f_code)
        if module is not None:
            return module
        above = above.f_back
    return None


@lru_cache(maxsize=1)
def calls() -> tuple[Call, ...]:
    """Calls between modules during the last frame that is tracked and no keyframe, in their order."""
    flown = film(stairs_world(), CAMERA, sideways(16, 0.03, turn_rad=0.004), step_s=1 / 30)
    slam = EdgeSlam(CAMERA, SlamConfig(depth=DepthConfig(weights="none")), depth=flown.depth_function())
    found: tuple[Call, ...] = ()
    for frame in flown.frames:
        seen: list[Call] = []

        def enter(inner: FrameType, event: str, _: object, seen: list[Call] = seen) -> None:
            module = module_of(inner.f_code) if event == "call" else None
            caller = caller_of(inner) if module is not None else None
            if module is not None and caller is not None:
                seen.append((caller, module, inner.f_code.co_qualname))

        prepared = slam.prepare(frame)  # on another thread in a run
        sys.setprofile(enter)
        try:
            output = slam.step(frame, (), prepared)
        finally:
            sys.setprofile(None)
        if output.status is FrameStatus.TRACKED and not output.keyframe:
            found = tuple(seen)
    assert found, "no frame was simply tracked"
    return found


def listed() -> list[str]:
    """Modules of `EdgeSlam.step`'s part of the page's list, in its order."""
    text = TABLE.read_text(encoding="utf-8").split("## From a recording to an output folder", 1)[1]
    part = text.split("EdgeSlam.step", 1)[1].split("writers/run_summary.py", 1)[0]
    return [f"edgeslam_torch.{name.replace('/', '.')}" for name in re.findall(r"([\w/]+)\.py", part)]


def test_the_page_lists_a_tracked_frames_way_in_its_order():
    entered = [called for _, called, _ in calls()]
    at = 0
    for module in listed():
        assert module in entered[at:], f"{module} is not entered after those before it in the list"
        at = entered.index(module, at) + 1


def test_the_page_leaves_out_only_helpers():
    helpers = {"geometry", "types", "stage_times"}
    entered = {called for _, called, _ in calls() if part_of(called) not in helpers}
    missing = entered - set(listed()) - {"edgeslam_torch.slam", "edgeslam_torch.tracking.lazy_view"}
    assert missing == set(), "docs/architecture.md does not list them"


def test_no_call_goes_up():
    up = {call for call in calls() if ROWS[part_of(call[1])] > ROWS[part_of(call[0])]}
    assert up == set()


def test_hops_between_folders_stay_few():
    beside = {"geometry", "types"}  # everybody calls them
    hops = {(a, b, name) for a, b, name in calls() if part_of(a) != part_of(b) and part_of(b) not in beside}
    assert 10 < len(hops) <= HOPS, sorted(hops)


def test_the_way_goes_on_in_a_higher_row_few_times():
    """What is read from top to bottom should lie so too; each climb is a return to a caller that then asks another."""
    entered = dict.fromkeys(called for _, called, _ in calls() if part_of(called) not in {"geometry", "types"})
    rows = [ROWS[part_of(module)] for module in entered if part_of(module) != "stage_times"]
    climbs = sum(after > before for before, after in pairwise(rows))
    assert 3 < climbs <= CLIMBS, list(entered)


@pytest.mark.parametrize("name", ["slam", "states/tracking", "optim/pose_only", "estimation/output_frame"])
def test_the_list_names_what_matters(name):
    assert f"edgeslam_torch.{name.replace('/', '.')}" in [*listed(), "edgeslam_torch.slam"]
