"""Map accuracy and completeness against measured depth, on a rendered wall whose distances are known."""

import numpy as np
import pytest
from rendered import RenderedFlight
from scipy.spatial import cKDTree

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.dataset import open_dataset
from edgeslam_torch.eval.metrics.align import Alignment
from edgeslam_torch.eval.metrics.edge_map_score import SurfaceTruth, build_surface, score_map
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.readers.layouts.seven_scenes import T_COLOUR_DEPTH
from edgeslam_torch.readers.sequence import register_depth
from edgeslam_torch.types import Frame

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
NEAR_M, FAR_M = 1.5, 3.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A camera slides along x in front of a wall at 3 m with a white board at 1.5 m before it."""
    T = np.tile(np.eye(4), (8, 1, 1))
    T[:, 0, 3] = np.linspace(-0.1, 0.1, 8)
    u, v = np.meshgrid(np.arange(160), np.arange(120))
    y = (v - CAMERA.cy) / CAMERA.fy * NEAR_M
    boards = [(np.abs((u - CAMERA.cx) / CAMERA.fx * NEAR_M + x) < 0.4) & (np.abs(y) < 0.3) for x in T[:, 0, 3]]
    frames = [Frame(i, 10.0 + i / 10.0, np.where(board, 220, 40).astype(np.uint8)) for i, board in enumerate(boards)]
    depths = [np.where(board, NEAR_M, FAR_M) * ((u >= 6) | (v >= 6)) for board in boards]
    return RenderedFlight(CAMERA, frames, depths, T, None).write(
        tmp_path_factory.mktemp("data") / "wall", depth_every=1
    )


@pytest.fixture(scope="module")
def truth(folder):
    return build_surface(open_dataset(folder))


def board_outline(step_m=0.005):
    a, b = np.arange(-0.4, 0.4, step_m), np.arange(-0.3, 0.3, step_m)
    sides = [np.stack([a, np.full_like(a, s * 0.3)], 1) for s in (-1, 1)]
    sides += [np.stack([np.full_like(b, s * 0.4), b], 1) for s in (-1, 1)]
    xy = np.concatenate(sides)
    return np.column_stack([xy, np.full(len(xy), NEAR_M)])


def test_true_edges_lie_on_the_near_side_of_the_board(truth):
    edges = truth.edges_w
    assert len(edges) > 50
    assert np.abs(edges[:, 2] - NEAR_M).max() < 0.01, "an edge belongs to what is in front"
    outline = np.maximum(np.abs(edges[:, 0]) / 0.4, np.abs(edges[:, 1]) / 0.3)
    np.testing.assert_allclose(outline, 1.0, atol=0.06)  # a pixel is 1.2 cm there


def test_perfect_map_is_accurate_and_complete(truth):
    found = score_map(board_outline(), Alignment(), truth)
    assert found.judged_share == 1.0
    assert found.median_m < 0.015  # pixels of the reduced depth map are 2.3 cm apart
    assert found.completeness[0.06] == 1.0 and found.f_score[0.06] > 0.99
    moved = Alignment(scale=2.0, t=np.array([0.0, 0.0, 2.0]))  # as the trajectory is
    assert score_map(board_outline() / 2.0 - [0, 0, 1.0], moved, truth).median_m == pytest.approx(found.median_m)


def test_depth_error_of_the_map_is_measured(truth):
    found = score_map(np.array([[0.0, 0.0, NEAR_M - 0.08]] * 200), Alignment(), truth)
    assert found.median_m == pytest.approx(0.08, abs=0.01)
    assert found.single_map_median_m == pytest.approx(0.08, abs=0.01)
    assert found.accuracy[0.06] == 0.0 and found.accuracy[0.10] == 1.0


def test_points_that_no_depth_map_sees_are_not_judged_but_counted(truth):
    behind_camera = np.array([[0.0, 0.0, -2.0]] * 60)
    found = score_map(np.concatenate([board_outline(), behind_camera]), Alignment(), truth)
    count = len(board_outline())
    assert found.points == count + 60
    assert found.judged_share == pytest.approx(count / (count + 60))
    with pytest.raises(EvaluationError, match="no map point"):
        score_map(behind_camera, Alignment(), truth)


def test_a_map_that_hides_a_point_says_nothing_about_it():
    """A wall at 3 m, a door before it in one depth map of three: a point 40 cm before the wall is 40 cm off."""
    wall, door = np.full((30, 40), 3.0, np.float32), np.full((30, 40), 1.0, np.float32)
    camera = Camera(40, 30, 32.0, 32.0, 19.5, 14.5)
    surface = SurfaceTruth(cKDTree(np.zeros((1, 3))), np.zeros((0, 3)), np.stack([wall, wall, door]), EYES, camera)
    before, on_door, behind = surface.single_map_distance(np.array([[0, 0, 2.6], [0, 0, 1.0], [0, 0, 5.0]]))
    assert before == pytest.approx(0.4, abs=0.01)
    assert on_door == pytest.approx(2.0, abs=0.05)  # median of 2, 2 and 0 m
    assert behind == pytest.approx(2.0, abs=0.05)  # hidden in all: the least distance to any


EYES = np.tile(np.eye(4), (3, 1, 1))


def test_own_alignment_takes_the_trajectorys_error_out(truth, rng):
    board = np.column_stack([rng.uniform(-0.35, 0.35, 400), rng.uniform(-0.25, 0.25, 400), np.full(400, NEAR_M)])
    wall = np.column_stack([rng.choice([-1, 1], 400) * 1.2, rng.uniform(-1, 1, 400), np.full(400, FAR_M)])
    found = score_map(np.concatenate([board, wall]) + [0.0, 0.0, 0.05], Alignment(), truth)
    assert found.median_m == pytest.approx(0.05, abs=0.01)
    assert found.own_alignment_median_m < 0.02


def test_depth_is_registered_to_another_camera():
    depth = np.full((120, 160), 2.0, np.float32)
    T = np.eye(4)
    T[0, 3] = -0.1
    moved = register_depth(depth, CAMERA, T, CAMERA)
    shift = 0.1 * CAMERA.fx / 2.0  # 6.5 px to the left
    filled = np.flatnonzero(moved[60] > 0)
    assert filled.max() == pytest.approx(159 - shift, abs=1.0)
    assert T_COLOUR_DEPTH[0, 3] == pytest.approx(-0.028, abs=1e-3)


def test_half_the_edges_make_half_the_completeness(truth):
    outline = board_outline()
    found = score_map(outline[outline[:, 0] < 0], Alignment(), truth)
    assert found.completeness[0.02] < 0.65
    assert 0.4 < found.completeness[0.06] < 0.65
    assert found.accuracy[0.06] == 1.0


def test_data_set_without_depth_is_refused(folder, tmp_path):
    (tmp_path / "groundtruth.txt").write_text((folder / "groundtruth.txt").read_text())
    with pytest.raises(EvaluationError, match="no depth maps"):
        build_surface(open_dataset(tmp_path))


@pytest.mark.slow
@pytest.mark.data
def test_measured_surface_of_a_recording_is_its_own_best_map(data_dir):
    truth = build_surface(open_dataset(data_dir / "tum_fr1_xyz"))
    found = score_map(truth.edges_w, Alignment(), truth)
    assert found.truth_edges > 5000
    assert found.median_m < 0.005 and found.completeness[0.02] == 1.0
