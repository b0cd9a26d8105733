"""Make the gallery's pictures: ``python docs/gallery.py runs/tum_fr1_xyz runs/hololens_a ...``.

Of each run its ``map.png`` with fewer pixels, and the keyframe half-way with the finished map's edges drawn in,
coloured by depth. The recordings must still lie where the runs read them.
"""

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np

from edgeslam_torch.eval.inputs.run_folder import RunFolder, open_run
from edgeslam_torch.eval.report.keyframe_pictures import keyframe_pictures
from edgeslam_torch.readers.images import pixels_or_none

GALLERY = Path(__file__).resolve().parent / "images" / "gallery"
_MAP_WIDTH_PX, _EDGES_WIDTH_PX = 1400, 640
_QUALITY = 85


def write(picture: np.ndarray, width_px: int, target: Path) -> None:
    """A picture of ``width_px`` at most, as WebP."""
    if picture.shape[1] > width_px:
        height = round(picture.shape[0] * width_px / picture.shape[1])
        picture = cv2.resize(picture, (width_px, height), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(target), picture, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])
    sys.stdout.write(f"{target}: {target.stat().st_size / 1e3:.0f} kB\n")


def edges_half_way(run: RunFolder) -> np.ndarray:
    """The keyframe in the middle of the flight, with the finished map's edges."""
    middle = len(run.trajectory) // 2  # where map.png looks from too
    keyframe = min(run.keyframe_poses(), key=lambda pose: abs(pose - middle))
    cloud = run.cloud()
    stamps_s = run.trajectory.stamps_s[[keyframe]]
    pictures = keyframe_pictures(run, cloud, stamps_s) if cloud is not None else []
    if not pictures:
        sys.exit(f"{run.path}: the run has no map, or its recording is no longer where it was")
    return pictures[0][1]


def main() -> None:
    """Two pictures for each run, named after its folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+", help="output folders of 'edgeslam run' or 'edgeslam demo'")
    GALLERY.mkdir(exist_ok=True)
    for path in parser.parse_args().runs:
        run = open_run(path)
        if (whole := pixels_or_none(path / "map.png", cv2.IMREAD_COLOR)) is None:
            sys.exit(f"{path}: no map.png; was the run finished?")
        write(whole, _MAP_WIDTH_PX, GALLERY / f"{run.name}.webp")
        write(edges_half_way(run), _EDGES_WIDTH_PX, GALLERY / f"{run.name}_edges.webp")


if __name__ == "__main__":
    main()
