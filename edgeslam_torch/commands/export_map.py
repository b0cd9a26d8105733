"""Map of a run for other programs: PLY, PCD, LAS, a COLMAP model, nerfstudio, or an occupancy grid."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from edgeslam_torch.errors import OutputError
from edgeslam_torch.files.output_file import add_overwrite_to, check_new, check_not_read
from edgeslam_torch.files.plain import subfolder

if TYPE_CHECKING:
    from edgeslam_torch.eval.inputs.run_folder import RunFolder
    from edgeslam_torch.types import Observations, PointCloud

_SAME_S = 1e-3
"""Stamps that differ by less are the same frame's."""
_KEEP = "of a bag or a video, 'edgeslam run --keep-images' keeps them"
_PLACES = {
    "ply": "export.ply",
    "pcd": "edge_map.pcd",
    "las": "edge_map.las",
    "colmap": "colmap",
    "nerfstudio": "nerfstudio",
    "occupancy": "occupancy",
}
"""Default of ``--out``, in the run's folder."""
FORMATS = tuple(_PLACES)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("run", type=Path, metavar="DIR", help="output folder of 'edgeslam run'")
    parser.add_argument("--format", choices=FORMATS, required=True)
    parser.add_argument("--out", type=Path, help="file, folder (colmap, nerfstudio) or file stem (occupancy)")
    add_overwrite_to(parser)
    parser.add_argument("--max-sigma", type=float, metavar="M", help="omit points with a larger sigma than this [m]")
    parser.add_argument(
        "--min-observations", type=int, default=1, metavar="N", help="omit points with fewer observations"
    )
    parser.add_argument("--resolution", type=float, default=0.05, metavar="M", help="side of an occupancy cell [m]")
    parser.add_argument("--min-z", type=float, metavar="M", help="lowest obstacle (default: 0.5 m below the camera)")
    parser.add_argument("--max-z", type=float, metavar="M", help="highest obstacle (default: 0.5 m above the camera)")
    parser.add_argument("--z-is-up", action="store_true", help="occupancy: take the map for level")


def main(args: argparse.Namespace) -> int:
    """Write the map and print its path."""
    from edgeslam_torch.eval.inputs.run_folder import open_run
    from edgeslam_torch.writers.own_folder import check_pictures, is_run

    run = open_run(args.run)
    out: Path = args.out or run.path / _PLACES[args.format]
    recording = [run.source] if run.source is not None else []
    replaces = args.overwrite or (args.out is None and is_run(run.path))
    for path in _files(out, args.format):
        check_not_read(path, recording if path.suffix in (".png", ".pgm") else [args.run], "--out")
        check_new(path, replaces)
    if args.format == "occupancy":
        check_pictures(out.parent, lambda path: path.with_suffix(".yaml").exists(), "give another --out")
    cloud = _chosen(run, args)
    if args.out is None and args.format in ("colmap", "nerfstudio"):
        subfolder(run.path, out.name)
    place = _WRITERS[args.format](run, cloud, out, args)
    print(f"{len(cloud.p_w)} points: {place}; {run.vertical}")
    if run.units == "arbitrary":
        print("the run's units are arbitrary (no metric scale): lengths in this file are not metres")
    elif run.units == "unknown":
        print("the folder does not say whether the run is metric: lengths are in its own units")
    return 0


def _files(out: Path, kind: str) -> list[Path]:
    """What will be written, the folders of nerfstudio's pictures by one that is there, else their first."""
    if kind == "occupancy":
        return [out.with_suffix(suffix) for suffix in (".pgm", ".yaml")]
    if kind == "colmap":
        return [out / name for name in ("cameras.txt", "images.txt", "points3D.txt")]
    if kind == "nerfstudio":
        folders = (out / name for name in ("images", "masks", "depth"))
        pictures = [next(folder.glob("*.png"), folder / "00000.png") for folder in folders]
        return [out / "transforms.json", out / "edge_map.ply", *pictures]
    return [out]


def _chosen(run: "RunFolder", args: argparse.Namespace) -> "PointCloud":
    import numpy as np

    from edgeslam_torch.types import PointCloud

    cloud = run.cloud()
    if cloud is None:
        raise OutputError(f"{run.path}: no edge_map.ply in this folder; run 'edgeslam run' first")
    if len(cloud.p_w) == 0:
        raise OutputError(f"{run.path}: the edge map is empty (too short a run, or no edges seen)")
    keep = np.isfinite(cloud.p_w).all(axis=1) & (cloud.observations >= args.min_observations)
    if args.max_sigma is not None:
        keep &= cloud.sigma_m <= args.max_sigma
    if not keep.any():
        raise OutputError(f"{run.path}: no point is left; relax --max-sigma or --min-observations")
    return PointCloud(cloud.p_w[keep], cloud.colour[keep], cloud.sigma_m[keep], cloud.observations[keep])


def _ply(run: "RunFolder", cloud: "PointCloud", path: Path, args: argparse.Namespace) -> Path:
    from edgeslam_torch.writers.maps.directions import edge_directions
    from edgeslam_torch.writers.ply import write_ply

    centres_w = run.trajectory.positions[run.keyframe_poses()]
    write_ply(path, cloud, (f"units: {run.units}", run.vertical), edge_directions(cloud.p_w, centres_w))
    return path


def _las(run: "RunFolder", cloud: "PointCloud", path: Path, args: argparse.Namespace) -> Path:
    from edgeslam_torch.writers.maps.las import write_las

    write_las(path, cloud, run.vertical)
    return path


def _pcd(run: "RunFolder", cloud: "PointCloud", path: Path, args: argparse.Namespace) -> Path:
    from edgeslam_torch.writers.maps.pcd import write_pcd

    write_pcd(path, cloud, run.vertical)
    return path


def _colmap(run: "RunFolder", cloud: "PointCloud", folder: Path, args: argparse.Namespace) -> Path:
    from edgeslam_torch.eval.report.keyframe_pictures import image_paths
    from edgeslam_torch.geometry.camera_file import load_camera
    from edgeslam_torch.writers.maps.colmap import write_colmap

    camera = load_camera(run.path / "camera.yaml")
    seen, anchors, index = _seen(run)
    paths = image_paths(run, seen.stamps_s)
    names = [p.name if p is not None else f"{t:.6f}.jpg" for p, t in zip(paths, seen.stamps_s, strict=True)]
    write_colmap(folder, camera, names, run.trajectory.T_w_c[index], cloud, anchors, seen, run.vertical)
    missing, renamed = paths.count(None), [name for name in names if " " in name]
    if missing:
        print(f"{missing} of {len(names)} images are not there; {_KEEP}")
    if renamed:
        print(f"{len(renamed)} names have blanks, which COLMAP does not take: rename them with '_', as {renamed[0]!r}")
    return folder


def _nerfstudio(run: "RunFolder", cloud: "PointCloud", folder: Path, args: argparse.Namespace) -> Path:
    from edgeslam_torch.eval.report.keyframe_pictures import image_paths
    from edgeslam_torch.geometry.camera_file import load_camera
    from edgeslam_torch.writers.maps.nerfstudio import write_nerfstudio

    camera = load_camera(run.path / "camera.yaml")
    seen, anchors, index = _seen(run)
    paths = [path for path in image_paths(run, seen.stamps_s) if path is not None]
    if len(paths) < len(index):
        have = f"{len(index) - len(paths)} of {len(index)} images of the keyframes are not there"
        raise OutputError(f"{run.path}: {have}; {_KEEP}")
    write_nerfstudio(folder, camera, paths, run.trajectory.T_w_c[index], cloud, anchors, seen, run.vertical)
    return folder


def _seen(
    run: "RunFolder", without: str = "points are not linked to images"
) -> "tuple[Observations, PointCloud, list[int]]":
    """What keyframes saw of the anchors, the anchors, and the keyframes' rows in the trajectory; `without` describes
    the consequence of a run without them."""
    import numpy as np

    from edgeslam_torch.eval.inputs.associate import nearest
    from edgeslam_torch.types import Observations
    from edgeslam_torch.writers.maps.colmap import NO_POINTS
    from edgeslam_torch.writers.observations import read_observations

    path, anchors = run.path / "observations.npz", run.cloud("anchors.ply")
    if not path.exists():
        print(f"{path}: not there (a run of version 0.1): {without}")
        rows, none = run.keyframe_poses(), np.zeros(0, np.int64)
        return Observations(run.trajectory.stamps_s[rows], none, none, np.zeros((0, 2))), NO_POINTS, rows
    seen = read_observations(path)
    if anchors is None or (len(seen.anchor) and seen.anchor.max() >= len(anchors.p_w)):
        raise OutputError(f"{run.path}: anchors.ply and observations.npz are of different runs; make the run again")
    index = nearest(run.trajectory.stamps_s, seen.stamps_s)
    if len(index) == 0 or np.abs(run.trajectory.stamps_s[index] - seen.stamps_s).max() > _SAME_S:
        raise OutputError(f"{run.path}: trajectory.txt lacks keyframes of observations.npz; make the run again")
    return seen, anchors, index.tolist()


def _occupancy(run: "RunFolder", cloud: "PointCloud", path: Path, args: argparse.Namespace) -> Path:
    import numpy as np

    from edgeslam_torch.writers.occupancy import SightLines, occupancy_grid, write_occupancy

    if run.units == "arbitrary":
        raise OutputError(f"{run.path}: no occupancy grid without metric scale; run with a depth network or telemetry")
    if run.up == "unknown" and not args.z_is_up:
        raise OutputError(
            f"{run.path}: no occupancy grid of a map that may be tilted: up is not known (older runs do not say; run "
            "again, with telemetry or accelerometer.txt); if z is up, say so with --z-is-up"
        )
    heights = None
    if args.min_z is not None or args.max_z is not None:
        middle = float(np.median(run.trajectory.positions[:, 2]))
        low = args.min_z if args.min_z is not None else middle - 0.5
        heights = (low, args.max_z if args.max_z is not None else middle + 0.5)
    seen, anchors, index = _seen(run, "free space of the grid needs camera poses")
    eye_w = run.trajectory.positions[index]
    lines = SightLines(eye_w[seen.keyframe], anchors.p_w[seen.anchor].astype(float), anchors.sigma_m[seen.anchor])
    write_occupancy(path, occupancy_grid(cloud.p_w, lines, run.trajectory.positions, args.resolution, heights))
    return path.with_suffix(".yaml")


_WRITERS = {
    "ply": _ply,
    "pcd": _pcd,
    "las": _las,
    "colmap": _colmap,
    "nerfstudio": _nerfstudio,
    "occupancy": _occupancy,
}
