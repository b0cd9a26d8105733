"""Precision and recall of place recognition: every keyframe of one map is matched against another map.

Every recording is processed in two halves, each from scratch, which yields independent maps of the same place and maps
of different places::

    python -m edgeslam_torch.eval.judge.place_recognition --data DIR --out DIR

Alternatively simulated rooms, all different, each on one path or several::

    python -m edgeslam_torch.eval.judge.place_recognition --rooms 15 --paths 1 --out DIR

A link between different places is false, and so is one between halves whose camera pose is wrong by more than 0.5 m or
20 degrees. A keyframe is a revisit when the true pose of a keyframe of the other half is within 0.5 m and 20 degrees
and at least five seconds away; it is recalled when a keyframe of the following second is linked correctly. Maps are
kept in ``--out`` and reused.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.atlas.atlas_file import read_atlas, write_atlas
from edgeslam_torch.atlas.links import Link, link
from edgeslam_torch.atlas.place_recognition import revisit_candidates
from edgeslam_torch.atlas.saved import SavedAtlas, unpack
from edgeslam_torch.config import SlamConfig
from edgeslam_torch.errors import EdgeSlamError
from edgeslam_torch.eval.inputs.dataset import find_recordings, interpolate, open_dataset
from edgeslam_torch.eval.judge import sources
from edgeslam_torch.eval.metrics.align import umeyama
from edgeslam_torch.files.atomic import write_atomically
from edgeslam_torch.geometry import se3, sim3
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.mapping.edges.edge_map import EdgeMap
from edgeslam_torch.readers.source import Recording, open_source
from edgeslam_torch.run import settle_camera
from edgeslam_torch.slam import EdgeSlam
from edgeslam_torch.synthetic.flights.courses import COURSES, simulated_camera
from edgeslam_torch.synthetic.flights.degrade import CameraFaults, degraded
from edgeslam_torch.synthetic.flights.flight import Flight, fly
from edgeslam_torch.synthetic.house.render import render
from edgeslam_torch.synthetic.house.world import World
from edgeslam_torch.tracking.tracker import Tracker
from edgeslam_torch.types import FloatArray, IntArray

NEAR_M, NEAR_RAD = 0.5, np.deg2rad(20.0)
AWAY_S, WITHIN_S = 5.0, 1.0
CLOSER_LOOKS = 3
"""Number of candidate keyframes per keyframe, as in flight."""
ROOM_S, ROOM_HZ = 12.0, 10.0
"""Length and rate of a flight through a simulated room."""
SAME_PLACE = ({"tum_fr1_xyz", "tum_fr1_rpy_depth"},)
"""Recordings of the same place; links between them are not scored."""


@dataclass(frozen=True, slots=True)
class Half:
    """Map of one half of a recording."""

    recording: str
    name: str
    atlas: SavedAtlas
    stamps_s: FloatArray
    """``(K,)`` of its keyframes."""
    T_w_c: FloatArray
    """``(K, 4, 4)`` their true poses; NaN where unknown."""

    @property
    def metres(self) -> float:
        """True metres per unit of the map; NaN when too little is known."""
        known = np.isfinite(self.T_w_c[:, 0, 0])
        if known.sum() < 3:
            return float("nan")
        centres = se3.inverse(self.atlas.arrays["keyframe.T_c_w"])[known, :3, 3]
        return umeyama(centres, self.T_w_c[known, :3, 3]).scale


@dataclass(frozen=True, slots=True)
class Pair:
    """Links between two maps."""

    links: int
    false: int
    agreeing: bool
    """Whether two false links agree, so that the submaps would have been merged."""
    revisits: int = 0
    recalled: int = 0


def fly_half(folder: Path, name: str, half: int, out: Path) -> Half:
    """Map of the first or second half of a recording, reused from an earlier call if present.

    Raises:
        EdgeSlamError: If it cannot be read.
    """
    file, stamps_file = out / f"{name}-{half}.atlas", out / f"{name}-{half}.npy"
    if not (file.is_file() and stamps_file.is_file()):
        source = open_source(folder)
        assert isinstance(source, Recording)
        middle = (source.length or 0) // 2
        source = sources.part(source, middle) if half else sources.part(source, count=middle)
        atlas, stamps = _flown(source, name)
        write_atlas(file, atlas)
        write_atomically(stamps_file, lambda file: np.save(file, stamps))
    atlas, stamps = read_atlas(file), np.load(stamps_file)
    T_w_c, known = interpolate(open_dataset(folder).truth, stamps)
    T_w_c = np.where(known[:, None, None], T_w_c, np.nan)
    return Half(name, f"{name} {'second' if half else 'first'} half", atlas, stamps, T_w_c)


def fly_room(seed: int, path: int, out: Path) -> Half:
    """Map of one of several paths through a simulated room, reused from an earlier call if present."""
    world = COURSES["room"].world(np.random.default_rng(seed))
    flight = fly(np.random.default_rng([seed, path]), world, round(ROOM_S * ROOM_HZ), rate_hz=ROOM_HZ)
    name = f"room {seed}"
    file, stamps_file = out / f"room-{seed}-{path}.atlas", out / f"room-{seed}-{path}.npy"
    if not (file.is_file() and stamps_file.is_file()):
        atlas, stamps = _flown(_pictures(world, flight, seed), name)
        write_atlas(file, atlas)
        write_atomically(stamps_file, lambda file: np.save(file, stamps))
    stamps = np.load(stamps_file)
    rows = np.abs(flight.stamps_s[None, :] - stamps[:, None]).argmin(axis=1)
    later_s = path * (ROOM_S + AWAY_S)
    return Half(name, f"{name} path {path}", read_atlas(file), stamps + later_s, flight.T_w_c[rows])


def _pictures(world: World, flight: Flight, seed: int) -> Recording:
    camera = simulated_camera()

    def picture(i: int) -> NDArray[np.uint8]:
        view, rng = render(world, camera, flight.T_w_c[i]), np.random.default_rng([seed, i])
        stamp_s, twist_c = float(flight.stamps_s[i]), flight.twist_c(i)
        return degraded(rng, view.image, view.depth_m, camera, CameraFaults(), stamp_s=stamp_s, twist_c=twist_c)

    return sources.made_of(picture, len(flight.stamps_s), camera, ROOM_HZ)


def _flown(source: Recording, name: str) -> tuple[SavedAtlas, FloatArray]:
    """The map of a recording, and the stamps of its keyframes."""
    settle_camera(source)
    slam = EdgeSlam(source.camera, SlamConfig())
    for frame in source.frames():
        slam.step(frame)
    slam.finish()
    atlas = slam.saved_atlas(name)
    stamps, T_w_c = slam.trajectory()
    centres = se3.inverse(atlas.arrays["keyframe.T_c_w"])[:, :3, 3]
    apart = np.linalg.norm(centres[:, None] - T_w_c[None, :, :3, 3], axis=2)
    return atlas, stamps[apart.argmin(axis=1)]


def compare(a: Half, b: Half, config: SlamConfig) -> Pair:
    """Match every keyframe of either map against the other."""
    slam_map = SlamMap(a.atlas.scale_factor, config.orb.levels)
    camera = a.atlas.camera
    edges = EdgeMap(slam_map, camera, config.edges, config.depth.prior_sigma_log)
    sides = []
    for half in (a, b):
        first, pieces = slam_map.next_keyframe_id(), len(slam_map.begun)
        unpack(_shifted(half.atlas, first, pieces), slam_map, edges, camera)
        sides.append([slam_map.keyframes[first + id] for id in half.atlas.arrays["keyframe.id"].tolist()])
    tracker = Tracker(slam_map, camera, config.orb, config.tracking)
    found = [_links(tracker, *sides), _links(tracker, *sides[::-1])]
    if a.recording != b.recording:
        wrong = [one for links in found for one in links]
        return Pair(len(wrong), len(wrong), _two_agree(wrong))
    right = [_right(found[0], sides[0], sides[1], a, b), _right(found[1], sides[1], sides[0], b, a)]
    wrong = [
        one for links, true in zip(found, right, strict=True) for one, ok in zip(links, true, strict=True) if not ok
    ]
    revisits = recalled = 0
    for links, true, side, here, there in zip(found, right, sides, (a, b), (b, a), strict=True):
        row_of = {k.id: row for row, k in enumerate(side)}
        linked = np.array([here.stamps_s[row_of[one.keyframe.id]] for one, ok in zip(links, true, strict=True) if ok])
        again = here.stamps_s[_revisits(here, there)]
        revisits += len(again)
        recalled += sum(bool(((linked >= t) & (linked <= t + WITHIN_S)).any()) for t in again)
    return Pair(sum(map(len, found)), len(wrong), _two_agree(wrong), revisits, recalled)


def _shifted(atlas: SavedAtlas, first: int, pieces: int) -> SavedAtlas:
    """The same with other numbers of keyframes and pieces, for a map that has some already."""
    arrays = dict(atlas.arrays)
    for name in ("keyframe.id", "removed.id", "removed.heir", "host.keyframe"):
        arrays[name] = arrays[name] + first
    arrays["anchor.host"] = np.where(arrays["anchor.host"] >= 0, arrays["anchor.host"] + first, -1)
    arrays["keyframe.piece"] = arrays["keyframe.piece"] + pieces
    return replace(atlas, arrays=arrays)


def _links(tracker: Tracker, mine: list[Keyframe], theirs: list[Keyframe]) -> list[Link]:
    found = []
    for keyframe in mine:
        tries = (
            link(tracker, keyframe, k) for k in revisit_candidates(tracker.map, keyframe.words, theirs, CLOSER_LOOKS)
        )
        found += [one for one in tries if one is not None][:1]
    return found


def _two_agree(links: list[Link]) -> bool:
    return any(
        one.agrees(other) and one.keyframe is not other.keyframe and one.other is not other.other
        for one, other in combinations(links, 2)
    )


def _right(links: list[Link], mine: list[Keyframe], theirs: list[Keyframe], a: Half, b: Half) -> list[bool]:
    """Which links have a correct relative pose; all if the truth is unknown."""
    here, there = ({k.id: row for row, k in enumerate(side)} for side in (mine, theirs))
    metres, answers = b.metres, []
    for one in links:
        T_w_k, T_w_o = a.T_w_c[here[one.keyframe.id]], b.T_w_c[there[one.other.id]]
        true = se3.inverse(T_w_o) @ T_w_k
        found = one.other.T_c_w @ se3.inverse(sim3.moved_camera(one.S, one.keyframe.T_c_w))
        unknown = not (np.isfinite(metres) and np.isfinite(true).all())
        answers.append(unknown or bool(_near(se3.scaled(found, metres)[None], true[None])[0, 0]))
    return answers


def _near(a: FloatArray, b: FloatArray) -> NDArray[np.bool_]:
    """Which poses ``(N, 4, 4)`` are near which ``(M, 4, 4)``: bool ``(N, M)``; False where unknown."""
    apart = np.linalg.norm(a[:, None, :3, 3] - b[None, :, :3, 3], axis=2)
    cosine = 0.5 * (np.einsum("nij,mij->nm", a[:, :3, :3], b[:, :3, :3]) - 1.0)
    near: NDArray[np.bool_] = (apart <= NEAR_M) & (cosine >= np.cos(NEAR_RAD))
    return near


def _revisits(here: Half, there: Half) -> IntArray:
    """Indices of keyframes that are revisits of the other half."""
    away = np.abs(here.stamps_s[:, None] - there.stamps_s[None, :]) >= AWAY_S
    return np.flatnonzero((_near(here.T_w_c, there.T_w_c) & away).any(axis=1))


def main(argv: Sequence[str] | None = None) -> int:
    """Print one line for every pair with a link or a revisit, and the totals."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--data", type=Path, help="folder of recordings with ground truth")
    what.add_argument("--rooms", type=int, metavar="N", help="simulated rooms instead, seeds 0 to N - 1")
    parser.add_argument("--paths", type=int, default=2, metavar="N", help="through each room")
    parser.add_argument("--out", type=Path, required=True, help="folder of the maps")
    parser.add_argument("--only", action="append", default=[], metavar="PATTERN", help="recordings by name")
    args = parser.parse_args(argv)
    args.out.mkdir(parents=True, exist_ok=True)
    try:
        halves = (
            _halves_of_recordings(args.data, args.only, args.out)
            if args.data
            else _rooms(args.rooms, args.paths, args.out)
        )
    except EdgeSlamError as error:
        print(error, file=sys.stderr)
        return 1
    if len(halves) < 2:
        print(f"{args.data or '--rooms'}: fewer than two flights with ground truth to compare", file=sys.stderr)
        return 1
    total = Pair(0, 0, False)
    pairs = joined = 0
    for a, b in combinations(halves, 2):
        if a.recording != b.recording and {a.recording, b.recording} in SAME_PLACE:
            continue
        found = compare(a, b, SlamConfig())
        pairs, joined = pairs + 1, joined + found.agreeing
        total = Pair(
            total.links + found.links,
            total.false + found.false,
            total.agreeing or found.agreeing,
            total.revisits + found.revisits,
            total.recalled + found.recalled,
        )
        if found.links or found.revisits:
            print(_line(f"{a.name}, {b.name}", found))
    print(_line(f"{pairs} pairs, {joined} falsely joined", total))
    return 0


def _rooms(count: int, paths: int, out: Path) -> list[Half]:
    return [fly_room(seed, path, out) for seed in range(count) for path in range(paths)]


def _halves_of_recordings(data: Path, only: Sequence[str], out: Path) -> list[Half]:
    halves: list[Half] = []
    for name, (folder, _) in find_recordings(data).items():
        if only and not any(fnmatchcase(name, pattern) for pattern in only):
            continue
        for half in (0, 1):
            try:
                halves.append(fly_half(folder, name, half, out))
            except EdgeSlamError as error:
                print(f"{name}: {error}", file=sys.stderr)
    return halves


def _line(name: str, found: Pair) -> str:
    recall = f", {found.recalled} of {found.revisits} revisits recalled" if found.revisits else ""
    return f"{name}: {found.links} links, {found.false} false{recall}"


if __name__ == "__main__":
    sys.exit(main())
