"""The script that people copy to their companion computers."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

SCRIPT = Path(__file__).parents[1] / "examples" / "depth_companion.py"


@pytest.fixture
def model(tmp_path):
    """A network in the form that ``edgeslam export`` writes: both outputs are the mean of the colours."""
    nodes = [helper.make_node("ReduceMean", ["image"], [name], axes=[1]) for name in ("log_depth", "sigma_log")]
    shape = {"image": [1, 3, 32, 32], "log_depth": [1, 1, 32, 32], "sigma_log": [1, 1, 32, 32]}
    given, one, two = (helper.make_tensor_value_info(name, TensorProto.FLOAT, shape[name]) for name in shape)
    graph = helper.make_graph(nodes, "depth", [given], [one, two])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    record = {"mean": [0.0, 0.0, 0.0], "std": [1.0, 1.0, 1.0], "focal_px": 16.0}
    helper.set_model_props(model, {"edgeslam": json.dumps(record)})
    onnx.save(model, tmp_path / "depth.onnx")
    return tmp_path / "depth.onnx"


def apart(*words):
    """The script in a process of its own, as people start it."""
    command = [sys.executable, str(SCRIPT), *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)


@pytest.fixture
def companion(monkeypatch, capsys):
    """Function that calls the script here: exit code, stdout and stderr."""
    spec = importlib.util.spec_from_file_location(SCRIPT.stem, SCRIPT)
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)

    def call(*words):
        monkeypatch.setattr(sys, "argv", [str(SCRIPT), *map(str, words)])
        return (script.main(), *capsys.readouterr())

    return call


def test_depth_of_a_picture(model, tmp_path):
    cv2.imwrite(str(tmp_path / "white.png"), np.full((64, 64, 3), 255, np.uint8))
    done = apart(model, "--source", tmp_path / "white.png", "--fx", 64, "--fy", 64)
    assert (done.returncode, done.stderr) == (0, "")
    # exp(1) m at 16 px; 64 px of 64 are 32 of 32
    assert done.stdout.startswith(f"frame 0: {2 * np.e:.2f} m ahead")


@pytest.mark.parametrize(
    "words", ["--source nothing.mp4", "--source {tmp}", "--source {tmp}/words.mp4", "--source {tmp}/words.mp4 --fx nan",
              "--source {tmp}/words.mp4 --frames 0"],
)  # fmt: skip
def test_a_source_without_a_picture_is_an_error(companion, model, tmp_path, words):
    (tmp_path / "words.mp4").write_text("not a video\n" * 99)
    code, out, err = companion(model, "--fx", 64, "--fy", 64, *words.format(tmp=tmp_path).split())
    assert (code, out) == (1, "") and err


def test_a_model_of_others_is_an_error_of_one_line(companion, model, tmp_path):
    foreign = onnx.load(model)
    del foreign.metadata_props[:]
    onnx.save(foreign, tmp_path / "foreign.onnx")
    (tmp_path / "words.onnx").write_text("not a model")
    for name, reason in (
        ("foreign", "not written by edgeslam export"),
        ("words", "not a model"),
        ("no", "not a model"),
    ):
        code, _, err = companion(tmp_path / f"{name}.onnx", "--source", "x.png", "--fx", 64, "--fy", 64)
        assert code == 1
        assert len(err.splitlines()) == 1
        assert f"{name}.onnx: {reason}" in err
