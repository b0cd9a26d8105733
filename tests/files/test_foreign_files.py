"""Whatever a file holds, each reader of files takes it or refuses it at once, in one line that names it."""

import os
import re

import pytest

from edgeslam_torch.atlas.atlas_file import read_atlas
from edgeslam_torch.config import SlamConfig
from edgeslam_torch.errors import EdgeSlamError
from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.experiment.figures import read_record
from edgeslam_torch.eval.inputs.run_folder import read_status
from edgeslam_torch.eval.inputs.trajectory_files import read_trajectory
from edgeslam_torch.eval.judge.table import read_thresholds
from edgeslam_torch.eval.metrics.depth_error import read_depth
from edgeslam_torch.files.config_file import load_config
from edgeslam_torch.files.record_files import read_mapping
from edgeslam_torch.frontend.depth_network import DepthPredictor
from edgeslam_torch.geometry.camera_file import read_camera
from edgeslam_torch.models.checkpoint import load_checkpoint
from edgeslam_torch.models.convert import read_upstream
from edgeslam_torch.models.onnx.file import parse_onnx
from edgeslam_torch.models.onnx.graph import build_graph
from edgeslam_torch.models.weights_file import read_weights
from edgeslam_torch.readers.images import read_image
from edgeslam_torch.readers.imu.table import read_readings
from edgeslam_torch.readers.source import open_source
from edgeslam_torch.readers.telemetry_csv import read_telemetry
from edgeslam_torch.synthetic.sites.scene_file import read_scene
from edgeslam_torch.train.views.shards import load_shards
from edgeslam_torch.writers.observations import read_observations
from edgeslam_torch.writers.ply import read_ply

READERS = {
    "a.atlas": read_atlas,
    "a.jpg": read_image,
    "a.json": lambda path: read_mapping(path, "JSON", EvaluationError),
    "a.mcap": open_source,
    "a.mp4": open_source,
    "a.npz": read_observations,
    "a.onnx": parse_onnx,
    "a.ply": read_ply,
    "a.png": read_depth,
    "a.pth": read_upstream,
    "a.safetensors": read_weights,
    "a.tar": load_shards,
    "a.toml": read_scene,
    "a.txt": read_trajectory,
    "a.yaml": read_camera,
    "b.onnx": DepthPredictor,
    "b.safetensors": load_checkpoint,
    "b.toml": lambda path: load_config(SlamConfig(), path),
    "bench.json": lambda path: read_record(path, "bench", (1, 2, 3), "runs"),
    "c.safetensors": build_graph,
    "imu.csv": read_readings,
    "telemetry.csv": read_telemetry,
    "thresholds.toml": read_thresholds,
}
TAKEN = {"a.onnx-empty", "a.toml-empty", "b.toml-empty", "thresholds.toml-empty"}
"""No bytes are a graph of nothing, and settings without a word."""
CONTENTS = {
    "binary": bytes(range(256)),
    "empty": b"",
    "nested": b"[" * 100_000,
    "none": b"null",
    "words": b"hello, this is none of ours\n",
    "zeros": bytes(1000),
}


def refusal(name, path):
    """One line, or nothing if the reader takes it."""
    try:
        READERS[name](path)
    except EdgeSlamError as error:
        said = str(error)
        assert path.name in said and "\n" not in said and len(said) < 600
        return said
    return ""


@pytest.mark.parametrize("content", CONTENTS)
@pytest.mark.parametrize("name", READERS)
def test_foreign_content_is_refused_in_one_line(tmp_path, name, content):
    (tmp_path / name).write_bytes(CONTENTS[content])
    assert bool(refusal(name, tmp_path / name)) == (f"{name}-{content}" not in TAKEN)


@pytest.mark.parametrize("name", READERS)
def test_what_is_no_file_is_refused_and_what_is_too_large_is_not_read(tmp_path, name):
    path = tmp_path / name
    assert refusal(name, path)
    path.mkdir()
    assert refusal(name, path)
    path.rmdir()
    os.mkfifo(path)
    assert refusal(name, path)
    path.unlink()
    with path.open("wb") as file:
        file.truncate(1 << 40)  # sparse: takes no room
    assert refusal(name, path)
    with pytest.raises(EvaluationError, match=re.escape(name)):
        read_status(path)  # it may be missing, so it is none of `READERS`
