"""Self-supervision from a SLAM run, on a rendered room with known poses and depth."""

import json
from contextlib import contextmanager
from dataclasses import replace
from unittest import mock

import cv2
import numpy as np
import pytest
import torch
from posed_run import CAMERA, FRAMES, world
from small_depth import RUNS, narrow_fastdepth

from edgeslam_torch.errors import SourceError
from edgeslam_torch.models.fastdepth import Prediction
from edgeslam_torch.synthetic.house.render import render
from edgeslam_torch.train.self_supervised import SelfSupervised
from edgeslam_torch.train.signals import Slot
from edgeslam_torch.train.teachers import teach as teacher
from edgeslam_torch.train.teachers.teach import log_metres, teach
from edgeslam_torch.train.validate import metres_by
from edgeslam_torch.train.views.edges import junction_points, seen_cosines, straight_edges
from edgeslam_torch.train.views.posed import is_run_folder, load_run, visible_points


@pytest.fixture(scope="module")
def sequence(run_folder):
    return load_run(run_folder)


def test_visible_points_lie_on_the_seen_surfaces(sequence):
    view = sequence.views[4]
    depth = render(world(), CAMERA, view.T_w_c).depth_m
    expected = depth[np.rint(view.uv[:, 1]).astype(int), np.rint(view.uv[:, 0]).astype(int)]
    assert np.mean(np.abs(np.log(view.z / expected)) < 0.1) > 0.9


def test_hidden_points_are_left_out():
    T = np.eye(4)
    near = np.stack([np.linspace(-0.2, 0.2, 50), np.zeros(50), np.full(50, 1.0)], 1)
    uv, z = visible_points(np.concatenate([near, near * 3.0]).astype(np.float32), CAMERA.K, T, (96, 128))
    assert len(z) == 50
    assert (z == 1.0).all()
    assert len(visible_points(-near, CAMERA.K, T, (96, 128))[1]) == 0


class _Oracle(torch.nn.Module):
    """Stub of a network: given log depths at the training focal length."""

    def __init__(self, signal, slots, factor):
        super().__init__()
        self.log = torch.stack([true_log_depth(signal, slot, which) for which in (0, 1) for slot in slots]) + float(
            np.log(factor)
        )

    def predict(self, x):
        return Prediction(self.log, torch.zeros_like(self.log))


def true_log_depth(signal, slot, which):
    """Rendered depth of what `draw` shows (zoom and flips are off)."""
    rng = slot.rng()
    s, i = signal._items[int(rng.integers(len(signal._items)))]
    sequence = signal.sequences[s]
    others = rng.choice(sequence.partners[i], 2)
    view = sequence.views[i] if which == 0 else sequence.views[int(others[0])]
    depth = render(world(), CAMERA, view.T_w_c).depth_m
    return torch.from_numpy(np.log(depth))[None]


@contextmanager
def never_flipped():
    """The loss is symmetric; the oracle above is not."""
    with mock.patch("edgeslam_torch.train.self_supervised.FLIP", 0.0):
        yield


def test_every_term_is_smallest_at_the_true_depth(sequence):
    signal = SelfSupervised([sequence], RUNS, zoom=(1.0, 1.0))
    slots = [Slot(0, 0, k) for k in range(2)]
    with never_flipped():
        batch, _ = signal.draw(slots)
        at = {f: signal.losses(_Oracle(signal, slots, f).predict(batch["image"]), batch) for f in (0.75, 1.0, 1.3)}
    for term in ("photometric", "points", "cycle"):
        wrong = min(at[0.75][term].mean(), at[1.3][term].mean())
        assert at[1.0][term].mean() < 0.6 * wrong, term
    assert at[1.0]["points"].max() < 0.05


@pytest.mark.parametrize("k", range(2))
def test_what_is_drawn_is_the_run_in_metres(sequence, k):
    """Brought to metres, baselines and depths are twice as long; points lie where the zoom puts them."""
    slot = Slot(3, 0, k)
    batches = [SelfSupervised([sequence], RUNS, log_scale=[s]).draw([slot])[0] for s in (0.0, float(np.log(2.0)))]
    units, metres = ({name: value[0].double() for name, value in b.items() if name != "image"} for b in batches)
    known = units["known"].bool()
    torch.testing.assert_close(metres["T_j_i"][:, :3, 3], 2.0 * units["T_j_i"][:, :3, 3])
    torch.testing.assert_close(metres["T_j_i"][:, :3, :3], units["T_j_i"][:, :3, :3])
    longer = (metres["log_z"] - units["log_z"])[known].numpy()
    np.testing.assert_allclose(longer, np.log(2.0), atol=1e-5)
    # The same points seen by the view itself: one of its own projections for each, mirrored or not.
    rng = slot.rng()
    view = sequence.views[sequence.usable[int(rng.integers(len(sequence.usable)))]]
    rays = np.column_stack([view.uv, np.ones(len(view.uv))]) @ np.linalg.inv(view.K).T
    K = units["K"].numpy()
    seen = rays[:, :2] * K[[0, 1], [0, 1]] + K[:2, 2]
    mirrored = rays[:, :2] * [-K[0, 0], K[1, 1]] + K[:2, 2]
    drawn = units["uv"][known].numpy()
    off = [np.abs(drawn[:, None] - p[None]).max(2).min(1).max() for p in (seen, mirrored)]
    assert min(off) < 0.01


def test_flipped_pairs_keep_their_geometry(sequence):
    """Map points of view i move to the same colours in view j, mirrored or not."""
    from edgeslam_torch.losses.base import back_project, move, project

    signal = SelfSupervised([sequence], RUNS)
    errors = []
    for k in range(8):
        b, _ = signal.draw([Slot(3, k, 0)])
        known = b["known"][0]
        uv, z = b["uv"][0][known], b["log_z"][0][known].exp()
        uv_j, front = project(move(b["T_j_i"][0, 0], back_project(uv, z, b["K"][0])), b["K"][0])
        inside = front & ((uv_j > 1) & (uv_j < torch.tensor([126.0, 94.0]))).all(-1)
        a = sample(b["rgb_i"], uv[inside])
        c = sample(b["rgb_j"][:, 0], uv_j[inside])
        errors.append(((a - c).abs().median() / (a - c[torch.randperm(len(c))]).abs().median()).item())
    assert max(errors) < 0.5


def sample(image, uv):
    grid = (2 * uv / torch.tensor([127.0, 95.0]) - 1)[None, None]
    return torch.nn.functional.grid_sample(image, grid, align_corners=True)[0, :, 0].T


def test_scale_of_an_arbitrary_run_is_found(sequence):
    depth = {v.name: render(world(), CAMERA, v.T_w_c).depth_m for v in sequence.views}
    smaller = replace(sequence, views=[replace(v, z=v.z / 3.0) for v in sequence.views])
    assert np.exp(log_metres(lambda view: depth[view.name], smaller)) == pytest.approx(3.0, rel=0.01)
    with pytest.raises(SourceError, match="no depth"):
        log_metres(lambda view: np.full(view.image.shape[:2], np.nan), smaller)


def test_straight_pieces_lie_on_straight_edges(rng):
    image = np.full((96, 128, 3), 30, np.uint8)
    cv2.rectangle(image, (30, 20), (90, 70), (200, 200, 200), -1)
    edges, arms = straight_edges(image, 100, 8, 8, rng)
    assert edges.shape == (100, 2)
    found = arms[arms[:, 0, 0] >= 0]
    assert len(found) >= 4
    for piece in found:
        centred = piece - piece.mean(0)
        assert np.linalg.svd(centred, compute_uv=False)[1] < 0.5
    blank_edges, blank_arms = straight_edges(np.zeros((96, 128, 3), np.uint8), 10, 4, 8, rng)
    assert (blank_edges == -1).all()
    assert (blank_arms == -1).all()


def test_junctions_of_two_views_are_paired_by_place_and_direction():
    image = np.full((96, 128, 3), 30, np.uint8)
    cv2.rectangle(image, (30, 20), (90, 70), (200, 200, 200), -1)
    found = torch.from_numpy(junction_points(image, 8))
    known = found[:, 0, 0] >= 0
    assert known.sum() >= 3
    moved = found[known] + 1.5
    assert torch.allclose(seen_cosines(moved, found), torch.zeros(len(moved)), atol=0.1)
    assert seen_cosines(moved + 20.0, found).isnan().all(), "too far away"
    turned = moved.clone()
    turned[:, 1:] = 2 * moved[:, :1] - moved[:, 1:]
    assert seen_cosines(turned, found).isnan().all(), "arms the other way"


@pytest.mark.slow
def test_teacher_measures_what_the_network_does_not_know(sequence, tmp_path, monkeypatch):
    monkeypatch.setattr(teacher, "WIDTH", 100)  # of views that are wider
    network = narrow_fastdepth()
    metres = 0.5
    errors, shares = [], []
    dense = teach(metres_by(network, RUNS), sequence, float(np.log(metres)), tmp_path)
    for view, taught in zip(sequence.views, dense, strict=True):
        error = np.abs(taught.view.depth_m / (metres * render(world(), CAMERA, view.T_w_c).depth_m) - 1)
        errors.append(np.median(error))
        shares.append(np.mean(error < 0.06))
    assert np.median(errors) < 0.03
    assert np.median(shares) > 0.6


@pytest.mark.slow
def test_finetune_command_runs_the_slam_on_a_flight(tmp_path, capsys):
    from edgeslam_torch.cli import main
    from edgeslam_torch.demo import DemoSettings, record
    from edgeslam_torch.models.checkpoint import load_checkpoint

    record(tmp_path / "flight", DemoSettings(seconds=3.0, rate_hz=12.0, width=320, height=240))
    out = tmp_path / "out"
    given = [str(tmp_path / "flight"), "--ignore-depth", "--out", str(out)]
    assert main(["finetune", *given, "--steps", "2", "--batch", "2"]) == 0
    assert "posed images without depth" in capsys.readouterr().out
    assert is_run_folder(out / "slam" / "flight")
    assert "flight" in load_checkpoint(out / "final.safetensors")[1].data


def test_run_is_read_with_poses_points_and_partners(run_folder, sequence):
    assert is_run_folder(run_folder)
    assert not is_run_folder(run_folder.parent)
    assert len(sequence.views) == FRAMES - 1, "the lost frame is left out"
    assert sequence.metric
    assert len(sequence.usable) == len(sequence.views)
    assert all(i not in partners for i, partners in enumerate(sequence.partners))
    assert min(len(v.z) for v in sequence.views) > 100


def test_missing_recording_is_named(run_folder, tmp_path):
    for name in ("trajectory.txt", "anchors.ply", "camera.yaml"):
        (tmp_path / name).write_bytes((run_folder / name).read_bytes())
    (tmp_path / "summary.json").write_text(json.dumps({"source": {"path": str(tmp_path / "gone")}}))
    with pytest.raises(SourceError, match="gone"):
        load_run(tmp_path)


def test_batch_follows_the_slot_alone(sequence):
    signal = SelfSupervised([sequence], RUNS)
    both, names = signal.draw([Slot(1, 7, 0), Slot(1, 7, 1)])
    second, name = signal.draw([Slot(1, 7, 1)])
    assert torch.equal(both["rgb_i"][1:], second["rgb_i"])
    assert torch.equal(both["image"][1::2], second["image"])
    assert names[1:] == name and name[0].startswith("run/0.")


def test_gradient_reaches_the_network(sequence):
    network = narrow_fastdepth()
    signal = SelfSupervised([sequence], RUNS)
    batch, _ = signal.draw([Slot(0, 0, 0)])
    losses = signal.losses(network.predict(batch["image"]), batch)
    assert set(losses) == {"photometric", "points", "cycle", "lshape", "smooth", "uncertainty"}
    sum(v.sum() for v in losses.values()).backward()
    grads = [p.grad for p in network.parameters() if p.grad is not None]
    assert grads
    assert all(torch.isfinite(g).all() for g in grads)
