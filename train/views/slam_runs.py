"""Runs of the SLAM on recordings without depth, kept in the fine-tuning's folder for the next time."""

import json
import logging
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from edgeslam_torch.config import DepthConfig, SlamConfig
from edgeslam_torch.errors import OutputError
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.files.signature import signature
from edgeslam_torch.readers.source import open_source
from edgeslam_torch.run import run, settle_camera
from edgeslam_torch.terminal.run_progress import RunProgress
from edgeslam_torch.train.views.posed import is_run_folder

logger = logging.getLogger(__name__)


def ensure_run(
    recording: Path,
    out: Path,
    weights: Path | None = None,
    camera: str | None = None,
    max_frames: int | None = None,
    apart: Path | None = None,
) -> None:
    """Run the SLAM on a recording, unless ``out`` holds this very run from before.

    Args:
        recording: Folder or video file.
        out: Folder of the run; ``out.json`` beside it records its inputs.
        weights: Of the depth network; the shipped ones when None.
        camera: Calibration file or preset; the recording's own when None.
        max_frames: Use only the first frames.
        apart: A folder that is no part of the recording although it may lie in it.

    Raises:
        SourceError: If the recording cannot be read.
        OutputError: If the run could not be written.
        KeyboardInterrupt: If the user stopped it; the next call starts again.
    """
    made_from = {
        "recording": signature(recording, apart),
        "weights": signature(weights) if weights is not None else None,
        "camera": signature(Path(camera)) if camera is not None and Path(camera).is_file() else camera,
        "max_frames": max_frames,
    }
    note = out.with_name(out.name + ".json")
    if is_run_folder(out) and _read(note) == made_from:
        return
    note.unlink(missing_ok=True)
    config = SlamConfig()
    if weights is not None:
        config = replace(config, depth=DepthConfig(weights=str(weights)))
    source = open_source(recording, camera, max_frames=max_frames)
    settle_camera(source)
    for warning in source.warnings:
        logger.warning("%s: %s", source.name, warning)
    with RunProgress(f"running {source.name}") as progress:
        progress.follow(source)
        result = run(source, out, config, listeners=[progress])
    if result.interrupted:
        raise KeyboardInterrupt
    if result.failure is not None:
        raise OutputError(result.failure)
    write_text(note, json.dumps(made_from) + "\n")


def _read(note: Path) -> Mapping[str, object] | None:
    try:
        content = json.loads(note.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    return content if isinstance(content, dict) else None
