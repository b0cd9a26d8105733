"""`KeyframeImages`: the pictures of a run's keyframes, kept beside its results for programs that need image files."""

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from edgeslam_torch.files.plain import subfolder, write_image
from edgeslam_torch.types import Frame, SlamOutput

if TYPE_CHECKING:
    from edgeslam_torch.run import Slam

logger = logging.getLogger(__name__)

FOLDER = "images"
_JPEG_QUALITY = 95
"""As cameras store them; a photogrammetry program sees no difference to the original."""


class KeyframeImages:
    """A listener of `edgeslam_torch.run.run`; a disk that fills up ends the pictures, not the run."""

    def __init__(self, run_folder: Path) -> None:
        self._run_folder = run_folder
        self._begun = self._failed = False
        self._may_become: dict[str, Path] = {}
        """Pictures of frames without a map, by stamp: the map that is found later may begin with them."""

    def on_frame(self, frame: Frame, output: SlamOutput, slam: object) -> None:
        """Write the picture of a keyframe, or of a frame that may become one, named by its stamp."""
        if self._failed or (output.status.supported and not output.keyframe):
            return
        try:
            folder = subfolder(self._run_folder, FOLDER)
            if not self._begun:
                for path in kept_images(self._run_folder).values():  # of an older run that this one replaces
                    path.unlink()
            self._begun = True
            path = folder / _name(frame.stamp_s)
            write_image(path, frame.image, (1, _JPEG_QUALITY))  # IMWRITE_JPEG_QUALITY
            if not output.keyframe:
                self._may_become[path.name] = path
        except OSError as error:
            self._failed = True
            logger.warning("images of keyframes are not kept any more (%s)", error.strerror or error)

    def on_finish(self, slam: "Slam") -> None:
        """Remove the pictures of frames that became no keyframes."""
        became = {_name(stamp_s) for stamp_s in slam.observations().stamps_s.tolist()}
        for name in self._may_become.keys() - became:
            self._may_become[name].unlink(missing_ok=True)


def _name(stamp_s: float) -> str:
    return f"{stamp_s:.6f}.jpg"


def kept_images(run_folder: Path) -> dict[float, Path]:
    """Stamp [s] to image file of what a run kept; empty if it kept none."""
    kept = {}
    for path in sorted((run_folder / FOLDER).glob("*.jpg")):
        try:
            kept[float(path.stem)] = path
        except ValueError:
            continue  # not named by a run
    return kept
