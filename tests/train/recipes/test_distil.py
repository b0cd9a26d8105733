"""A larger network's depth, brought to a run's map, as labels for a small one."""

import argparse
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
import torch
from posed_run import CAMERA, world

from edgeslam_torch.commands.training import distil as command
from edgeslam_torch.errors import SourceError
from edgeslam_torch.models.checkpoint import load_checkpoint
from edgeslam_torch.models.layout import Variant
from edgeslam_torch.models.onnx.graph import build_graph
from edgeslam_torch.models.record import DEFAULT_WEIGHTS
from edgeslam_torch.synthetic.house.render import render
from edgeslam_torch.train.recipes.distil import brought_to_map, label, new_student
from edgeslam_torch.train.teachers import teach
from edgeslam_torch.train.validate import coverage, residuals_and_sigma
from edgeslam_torch.train.views.augment import View
from edgeslam_torch.train.views.posed import load_run
from edgeslam_torch.types import DepthMap


@pytest.fixture(scope="module")
def sequence(run_folder):
    return load_run(run_folder)


class Oracle:
    """Knows the world; its depth is what ``change`` makes of the truth."""

    weights = Path("oracle.onnx")
    backend = "none"

    def __init__(self, sequence, change=lambda z: z, relative=False):
        self.poses = {v.image.tobytes(): v.T_w_c for v in sequence.views}
        self.change, self.is_metric = change, not relative

    def __call__(self, image, camera):
        true = cv2.resize(true_depth(self.poses[image.tobytes()]), (camera.width, camera.height))
        depth = self.change(true).astype(np.float32)
        return DepthMap(depth, np.full_like(depth, 0.2), is_relative=not self.is_metric)


def true_depth(T_w_c):
    return render(world(), CAMERA, T_w_c).depth_m


def error(depth, T_w_c):
    height, width = depth.shape
    return np.abs(depth / cv2.resize(true_depth(T_w_c), (width, height), interpolation=cv2.INTER_NEAREST) - 1)


@pytest.mark.parametrize(
    ("change", "relative"),
    [(lambda z: 0.6 * z, False), (lambda z: 1.0 / (0.4 / z + 0.3), True)],
    ids=["another scale", "relative"],
)
def test_teacher_is_brought_to_the_map(sequence, change, relative):
    view = sequence.views[3]
    depth = brought_to_map(Oracle(sequence, change, relative), view, float(np.log(2.0)))
    assert np.median(error(depth / 2.0, view.T_w_c)) < 0.01


def test_teacher_that_takes_near_for_far_is_not_believed(sequence, tmp_path, monkeypatch):
    monkeypatch.setattr(teach, "MOST", 2)
    wrong = Oracle(sequence, lambda z: 2.0 / z, relative=True)
    assert brought_to_map(wrong, sequence.views[3], 0.0) is None
    with pytest.raises(SourceError, match=r"oracle\.onnx agrees with the map in none"):
        label(wrong, sequence, 0.0, tmp_path)


def test_labels_are_measured_where_they_can_be_and_the_teachers_elsewhere(sequence, tmp_path, monkeypatch):
    monkeypatch.setattr(teach, "MOST", 4)
    labels = label(Oracle(sequence, lambda z: 1.0 / (0.4 / z + 0.3), relative=True), sequence, 0.0, tmp_path)
    assert labels.left_out == ()
    for view, posed in zip(labels.views, [sequence.views[i] for i in (0, 3, 6, 10)], strict=True):
        off = error(view.depth_m, posed.T_w_c)
        assert np.median(off) < 0.03 and np.mean(off < 0.1) > 0.8


@pytest.mark.slow
def test_a_teacher_whose_metres_are_others_is_warned_of(sequence, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(teach, "MOST", 2)
    for times, warned in ((1.0, False), (12.0, True)):
        label(Oracle(sequence, lambda z, k=times: k * z), sequence, float(np.log(times)), tmp_path / str(times))
        assert ("times the network's" in caplog.text) == warned


@pytest.mark.parametrize("variant", [Variant.PRUNED, pytest.param(Variant.NNCONV5DW, marks=pytest.mark.slow)])
def test_student_begins_with_what_fits_of_the_shipped_weights(variant):
    student, metadata = new_student(variant)
    shipped = load_checkpoint(None)[0]
    same = [
        all(torch.equal(a, b) if a.shape == b.shape else False for a, b in zip(new, old, strict=True))
        for new, old in zip(map(values, student.encoder()), map(values, shipped.encoder()), strict=True)
    ]
    assert metadata.variant == variant
    assert all(same) == (variant is not Variant.PRUNED)
    again = new_student(variant)[0].state_dict()
    assert all(torch.equal(v, again[k]) for k, v in student.state_dict().items()), "a training can be resumed"


def values(layer):
    return list(layer.state_dict().values())


def teacher_file(path):
    """The shipped network, as a relative network of somebody else."""
    content, metadata = build_graph(DEFAULT_WEIGHTS)
    model = onnx.load_model_from_string(content)
    del model.metadata_props[:]
    model.graph.node.extend(
        [onnx.helper.make_node("Neg", ["log_depth"], ["less"]), onnx.helper.make_node("Exp", ["less"], ["inverse"])]
    )
    del model.graph.output[:]
    model.graph.output.append(onnx.helper.make_tensor_value_info("inverse", onnx.TensorProto.FLOAT, None))
    onnx.save(model, str(path))
    mean, std = list(metadata.mean), list(metadata.std)
    path.with_suffix(".toml").write_text(
        f'gives = "relative_inverse"\nmean = {mean}\nstd = {std}\nmultiple = 32\ninput_height = 96\ninput_width = 128\n'
    )
    return path


def true_small(view):
    height, width = view.image.shape[:2]
    return cv2.resize(true_depth(view.T_w_c), (width, height), interpolation=cv2.INTER_NEAREST)


def coverage_of(network, metadata, views):
    """Share of true log depth within one sigma."""
    residuals, raw = residuals_and_sigma(network, metadata, views)
    return coverage(residuals, np.hypot(metadata.sigma_scale * raw, metadata.sigma_floor))[0]


def arguments(tmp_path, *words):
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    given = ("--out", tmp_path / "out", "--steps", "2", "--batch", "2", *words)
    return parser.parse_args([str(word) for word in given])


@pytest.mark.slow
def test_distil_command_writes_weights_and_says_what_was_learnt(run_folder, tmp_path, capsys):
    teacher = teacher_file(tmp_path / "teacher.onnx")
    words = (run_folder, "--teacher", teacher, "--depth", "mobilenet-nnconv5dw-skipadd-pruned")
    assert command.main(arguments(tmp_path, *words)) == 0
    printed = capsys.readouterr().out
    assert "| before |" in printed
    student, metadata = load_checkpoint(tmp_path / "out" / "weights.safetensors")
    assert metadata.variant == Variant.PRUNED
    assert (metadata.sigma_scale, metadata.sigma_floor) != (1.0, 0.0), "of the student's own errors"
    held_out = [v for v in load_run(run_folder).views if v.z.size]
    truths = [View(v.image, true_small(v), v.K) for v in held_out]
    assert coverage_of(student, metadata, truths) == pytest.approx(0.68, abs=0.25)
    assert command.main(arguments(tmp_path, *words)) == 0
    assert "nothing was left to train" in capsys.readouterr().out
