import cv2
import numpy as np
import pytest

from edgeslam_torch.types import PointCloud, Units
from edgeslam_torch.writers.map_picture import write_map_picture


def cloud(points):
    count = len(points)
    red = np.tile(np.array([[250, 0, 0]], np.uint8), (count, 1))
    return PointCloud(np.asarray(points, np.float32), red, np.ones(count, np.float32), np.ones(count, np.int32))


def path(count):
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, 0, 3] = np.linspace(0.0, 1.0, count)
    return T


def reds(picture):
    """Pixels of the map's points, however much of the page shines through."""
    b, g, r = (picture[:, :, c].astype(int) for c in range(3))
    return int(((r - g > 50) & (np.abs(g - b) < 25)).sum())


def oranges(picture):
    """Pixels of the camera's path."""
    return int((np.abs(picture[:, :, ::-1].astype(int) - [255, 157, 46]).max(axis=2) < 40).sum())


def test_map_and_path_are_there_and_a_far_straggler_does_not_shrink_them(tmp_path, rng):
    points = np.concatenate([rng.random((3000, 3)) * [2.0, 1.0, 1.0] + [0.0, 0.0, 2.0], [[1e5, 0, 0]]])
    write_map_picture(tmp_path / "map.png", cloud(points), path(50), Units.METRES, "title")
    picture = cv2.imread(str(tmp_path / "map.png"))
    assert reds(picture) > 3000
    assert oranges(picture) > 500


@pytest.mark.parametrize(
    ("points", "frames"),
    [([], 1), ([], 0), ([[0, 0, 0]], 2), ([[1, 1, 1]] * 50, 3), ([[np.nan] * 3, [np.inf] * 3, [1, 2, 3]], 3)],
)
def test_poor_maps_still_give_a_picture(tmp_path, points, frames):
    write_map_picture(tmp_path / "map.png", cloud(np.reshape(points, (-1, 3))), path(frames), Units.ARBITRARY, "")
    assert cv2.imread(str(tmp_path / "map.png")) is not None
