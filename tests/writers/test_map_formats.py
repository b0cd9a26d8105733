"""A map in the formats of others: points, images and pixels agree, also for readers that we did not write."""

import importlib.util
import io
import json
import subprocess
import sys
import zipfile
from dataclasses import replace

import cv2
import numpy as np
import pytest

from edgeslam_torch.errors import SourceError
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import PRESETS
from edgeslam_torch.types import Observations, PointCloud
from edgeslam_torch.writers.maps.colmap import write_colmap
from edgeslam_torch.writers.maps.directions import edge_directions
from edgeslam_torch.writers.maps.nerfstudio import sparse_depth, write_nerfstudio
from edgeslam_torch.writers.observations import read_observations, write_observations

CAMERA = PRESETS["tum_fr1"]
POSES = np.stack([np.eye(4), se3.exp(np.array([0.3, -0.1, 0.05, 0.02, -0.1, 0.03]))])


def cloud(p_w):
    count = len(p_w)
    colour = np.tile(np.array([10, 20, 30], np.uint8), (count, 1))
    return PointCloud(p_w.astype(np.float32), colour, np.full(count, 0.02, np.float32), np.full(count, 2, np.int32))


@pytest.fixture
def anchors(rng):
    return cloud(rng.uniform([-0.5, -0.4, 2.0], [0.5, 0.4, 4.0], (40, 3)))


@pytest.fixture
def seen(anchors):
    """All anchors in the first image, every other one in the second, where an ideal camera sees them."""
    pairs = [(0, i) for i in range(40)] + [(1, i) for i in range(0, 40, 2)]
    keyframe, anchor = np.array(pairs).T
    p_c = np.stack([se3.transform(se3.inverse(POSES[k]), anchors.p_w[[i]])[0] for k, i in pairs])
    return Observations(np.array([1.0, 2.0]), keyframe, anchor, CAMERA.project(p_c).astype(np.float32))


READ_COLMAP = """
import json, sys, numpy as np, pycolmap
r = pycolmap.Reconstruction(sys.argv[1])
errors, tracks = [], []
for number, point in r.points3D.items():
    tracks.append(point.track.length())
    for element in point.track.elements:
        image = r.images[element.image_id]
        measured = image.points2D[element.point2D_idx]
        assert measured.point3D_id == number, "the image's point names another one"
        errors.append(float(np.linalg.norm(image.project_point(point.xyz) - measured.xy)))
print(json.dumps({"tracks": tracks, "worst_px": max(errors), "observations": r.compute_num_observations()}))
"""


def test_colmap_links_points_to_the_pixels_that_saw_them(anchors, seen, tmp_path):
    if importlib.util.find_spec("pycolmap") is None:
        pytest.skip("pycolmap is not installed: the COLMAP model is not read by COLMAP")
    edges = cloud(np.array([[0.0, 0.0, 3.0], [0.1, 0.0, 3.0]]))
    write_colmap(tmp_path, CAMERA, ["a.png", "b.png"], POSES, edges, anchors, seen)
    # In its own process: pycolmap and OpenCV each bring a zlib, and both in one process crash.
    command = [sys.executable, "-c", READ_COLMAP, str(tmp_path)]
    found = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    assert sorted(found["tracks"]) == [0] * 2 + [1] * 20 + [2] * 20
    assert found["observations"] == 60
    assert found["worst_px"] < 0.02, "pixels have three decimals, points six digits"


@pytest.mark.parametrize("damage", ["missing", "text", "cut", "foreign", "short", "claim"])
def test_observations_come_back_as_they_were_and_damaged_ones_are_one_line(damage, seen, tmp_path):
    path = tmp_path / "o.npz"
    write_observations(path, seen)
    again = read_observations(path)
    for name in ("stamps_s", "keyframe", "anchor", "uv"):
        np.testing.assert_array_equal(getattr(again, name), getattr(seen, name))
    if damage == "short":
        write_observations(path, replace(seen, uv=seen.uv[:3]))
    if damage == "missing":
        path.unlink()
    elif damage == "text":
        path.write_text("nothing")
    elif damage == "cut":
        path.write_bytes(path.read_bytes()[:300])
    elif damage == "claim":  # a table of 8 TB
        head = io.BytesIO()
        np.lib.format.write_array_header_1_0(head, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
        with zipfile.ZipFile(path, "w") as packed:
            packed.writestr("stamps_s.npy", head.getvalue())
    elif damage == "foreign":
        write_observations(path, replace(seen, keyframe=seen.keyframe + 5))
    with pytest.raises(SourceError, match=r"o\.npz: [^\n]*again"):
        read_observations(path)


def test_nerfstudio_sees_each_anchor_where_the_image_has_it(anchors, seen, tmp_path, rng):
    images = []
    for name in ("a.png", "b.png"):
        images.append(tmp_path / name)
        cv2.imwrite(str(images[-1]), rng.integers(0, 255, (CAMERA.height, CAMERA.width, 3)).astype(np.uint8))
    write_nerfstudio(tmp_path / "n", CAMERA, images, POSES, anchors, anchors, seen)
    scene = json.loads((tmp_path / "n" / "transforms.json").read_text())
    for number, frame in enumerate(scene["frames"]):
        own = seen.keyframe == number
        # As its documentation says: camera to world, y up, looking along -z, first pixel's centre at (.5, .5).
        world_to_gl = np.linalg.inv(np.array(frame["transform_matrix"]))
        p = anchors.p_w[seen.anchor[own]] @ world_to_gl[:3, :3].T + world_to_gl[:3, 3]
        u = scene["fl_x"] * p[:, 0] / -p[:, 2] + scene["cx"]
        v = scene["fl_y"] * -p[:, 1] / -p[:, 2] + scene["cy"]
        np.testing.assert_allclose(np.stack([u, v], axis=1) - 0.5, seen.uv[own], atol=1e-3)
        depth = cv2.imread(str(tmp_path / "n" / frame["depth_file_path"]), cv2.IMREAD_UNCHANGED)
        metres = depth[np.rint(v - 0.5).astype(int), np.rint(u - 0.5).astype(int)] * scene["depth_unit_scale_factor"]
        np.testing.assert_allclose(metres, -p[:, 2], atol=6e-4)
        assert np.count_nonzero(depth) == own.sum()
        mask = cv2.imread(str(tmp_path / "n" / frame["mask_path"]), cv2.IMREAD_UNCHANGED)
        assert set(np.unique(mask)) == {0, 255} and (tmp_path / "n" / frame["file_path"]).is_file()
    assert (tmp_path / "n" / scene["ply_file_path"]).is_file()
    with pytest.raises(SourceError, match=r"gone\.png: cannot be read"):
        write_nerfstudio(tmp_path, CAMERA, [tmp_path / "gone.png"] * 2, POSES, anchors, anchors, seen)


def test_directions_follow_edges_and_are_zero_where_there_is_none(rng):
    along = np.array([2.0, -1.0, 0.5]) / np.sqrt(5.25)
    camera = np.array([[0.0, 0.0, -3.0]])
    line = np.linspace(0, 1, 200)[:, None] * along
    rays = (line - camera) / np.linalg.norm(line - camera, axis=1, keepdims=True)
    noisy = line + rays * rng.normal(0, 0.004, (200, 1))  # as far off along the ray as a neighbour is away
    ball = rng.normal(0, 0.05, (400, 3)) + 5.0
    found = edge_directions(np.concatenate([noisy, ball]), camera)
    assert np.median(found[:200] @ along) > 0.98
    assert np.mean(np.linalg.norm(found[200:], axis=1) < 0.5) > 0.4
    assert edge_directions(np.zeros((2, 3)), camera).tolist() == [[0.0] * 3] * 2


def test_las_reader_gives_the_cloud_back(anchors, tmp_path):
    laspy = pytest.importorskip("laspy", reason="laspy is not installed")
    from edgeslam_torch.writers.maps.las import write_las

    write_las(tmp_path / "m.las", anchors)
    found = laspy.read(tmp_path / "m.las")
    np.testing.assert_allclose(found.xyz, anchors.p_w, atol=6e-5)
    np.testing.assert_array_equal(np.stack([found.red, found.green, found.blue], axis=1) // 257, anchors.colour)
    np.testing.assert_array_equal(found["sigma"], anchors.sigma_m)


def test_nearest_of_two_points_of_a_pixel_is_its_depth():
    p_w = np.array([[0.0, 0.0, 2.0], [0.0, 0.0, 1.5], [0.0, 0.0, -1.0]])
    uv = np.tile([[CAMERA.cx, CAMERA.cy]], (3, 1))
    depth = sparse_depth(CAMERA, np.eye(4), p_w, uv)
    assert depth.max() == 1500 and np.count_nonzero(depth) == 1
