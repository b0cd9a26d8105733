"""`KeyframeImages`: the pictures of a run's keyframes, kept beside its results for programs that need image files."""

import logging
from pathlib import Path

from edgeslam_torch.files.plain import subfolder, write_image
from edgeslam_torch.types import Frame, SlamOutput

logger = logging.getLogger(__name__)

FOLDER = "images"
_JPEG_QUALITY = 95
"""As cameras store them; a photogrammetry program sees no difference to the original."""


class KeyframeImages:
    """A listener of `edgeslam_torch.run.run`; a disk that fills up ends the pictures, not the run."""

    def __init__(self, run_folder: Path) -> None:
        self._run_folder = run_folder
        self._begun = self._failed = False

    def on_frame(self, frame: Frame, output: SlamOutput, slam: object) -> None:
        """Write the picture of a keyframe, named by its stamp."""
        if self._failed or not output.keyframe:
            return
        try:
            folder = subfolder(self._run_folder, FOLDER)
            if not self._begun:
                for path in kept_images(self._run_folder).values():  # of an older run that this one replaces
                    path.unlink()
            self._begun = True
            write_image(folder / f"{frame.stamp_s:.6f}.jpg", frame.image, (1, _JPEG_QUALITY))  # IMWRITE_JPEG_QUALITY
        except OSError as error:
            self._failed = True
            logger.warning("images of keyframes are not kept any more (%s)", error.strerror or error)

    def on_finish(self, slam: object) -> None:
        """Nothing more to write."""


def kept_images(run_folder: Path) -> dict[float, Path]:
    """Stamp [s] to image file of what a run kept; empty if it kept none."""
    kept = {}
    for path in sorted((run_folder / FOLDER).glob("*.jpg")):
        try:
            kept[float(path.stem)] = path
        except ValueError:
            continue  # not named by a run
    return kept
