"""Make the README's picture of a report from a run: ``python docs/pictures.py runs/fr1`` (needs chromium).

``report.png`` is the upper part of the page, with fewer pixels and colours. Clip: ``clip.py``; gallery: ``gallery.py``.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

from edgeslam_torch.eval.report.page import write_report

ROOT = Path(__file__).resolve().parent.parent
sys.path.append(str(ROOT / "tests" / "helpers"))

from browser import PROGRAM, Browser  # noqa: E402  # the tests' own, not installed

IMAGES = ROOT / "docs" / "images"
_WIDTH_PX = 1400
_LEVELS = 51
"""Levels per channel: half the file size without visible difference; 0 and 255 are kept."""

_ALL_DRAWN = """new Promise(done => {
  const look = () => viewer.dirty || viewer.moving || viewer.drawn < viewer.total() ?
    requestAnimationFrame(look) : setTimeout(done, 500);
  look();
})"""


def shrink(source: Path, target: Path) -> None:
    """Write a picture small enough for a repository."""
    image = cv2.imread(str(source))
    if image.shape[1] > _WIDTH_PX:
        height = round(image.shape[0] * _WIDTH_PX / image.shape[1])
        image = cv2.resize(image, (_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
    step = 255 / _LEVELS
    image = (np.round(image / step) * step).round().astype(np.uint8)
    cv2.imwrite(str(target), image, [cv2.IMWRITE_PNG_COMPRESSION, 9])


def photograph(page: Path, target: Path) -> None:
    """The page as a window of 1280 x 1400 shows it."""
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder,
        Browser(Path(folder) / "profile") as browser,
    ):
        browser.open(page, width=1280, height=1400)
        browser.run(_ALL_DRAWN)
        browser.picture(Path(folder) / "page.png")
        shrink(Path(folder) / "page.png", target)


def main() -> None:
    """Photograph the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="output folder of 'edgeslam run' on tum_fr1_xyz")
    parser.add_argument("--groundtruth", "-g", type=Path, help="the recording, when the run no longer finds it")
    options = parser.parse_args()
    if PROGRAM is None:
        sys.exit("no chromium here: report.png is left as it is")
    photograph(write_report(options.run, options.groundtruth), IMAGES / "report.png")
    sys.stdout.write(f"{IMAGES / 'report.png'}: {(IMAGES / 'report.png').stat().st_size / 1e3:.0f} kB\n")


if __name__ == "__main__":
    main()
