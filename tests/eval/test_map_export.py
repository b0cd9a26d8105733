"""Exported maps open in third-party readers."""

import argparse
import importlib.util
import json
import subprocess
import sys
from dataclasses import astuple

import cv2
import numpy as np
import pytest
import yaml
from summaries import with_summary

from edgeslam_torch.cli import main
from edgeslam_torch.commands import export_map
from edgeslam_torch.errors import EdgeSlamError, OutputError
from edgeslam_torch.geometry.camera import PRESETS
from edgeslam_torch.geometry.camera_file import save_camera
from edgeslam_torch.types import PointCloud
from edgeslam_torch.writers.maps.colmap import write_colmap
from edgeslam_torch.writers.maps.pcd import write_pcd
from edgeslam_torch.writers.occupancy import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    OccupancyGrid,
    SightLines,
    occupancy_grid,
    write_occupancy,
)
from edgeslam_torch.writers.ply import write_ply


def test_the_map_of_a_run_is_not_replaced_by_a_part_of_it(tmp_path, cloud, capsys):
    write_ply(tmp_path / "edge_map.ply", cloud)
    (tmp_path / "trajectory.txt").write_text("0 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n")
    before = (tmp_path / "edge_map.ply").read_bytes()
    out = str(tmp_path / "edge_map.ply")
    assert main(["export-map", str(tmp_path), "--format", "ply", "--max-sigma", "0.05", "-o", out, "--overwrite"]) == 1
    assert "is what the command reads" in capsys.readouterr().err
    assert (tmp_path / "edge_map.ply").read_bytes() == before


@pytest.fixture
def cloud(rng):
    return PointCloud(
        rng.normal(size=(50, 3)).astype(np.float32),
        rng.integers(0, 256, (50, 3)).astype(np.uint8),
        rng.uniform(0.01, 0.1, 50).astype(np.float32),
        rng.integers(1, 9, 50).astype(np.int32),
    )


def test_pcd_is_what_the_format_page_says(cloud, tmp_path):
    """Read by the header alone, as a PCL reader does."""
    write_pcd(tmp_path / "m.pcd", cloud)
    head, body = (tmp_path / "m.pcd").read_bytes().split(b"DATA binary\n")
    words = {line.split()[0]: line.split()[1:] for line in head.decode().splitlines() if not line.startswith("#")}
    kinds = {"F": "f", "I": "i", "U": "u"}
    types = [
        (name, f"<{kinds[kind]}{size}")
        for name, kind, size in zip(words["FIELDS"], words["TYPE"], words["SIZE"], strict=True)
    ]
    points = np.frombuffer(body, np.dtype(types))
    assert len(points) == int(words["POINTS"][0]) == int(words["WIDTH"][0]) * int(words["HEIGHT"][0]) == 50
    np.testing.assert_array_equal(np.stack([points[axis] for axis in "xyz"], axis=1), cloud.p_w)
    bits = points["rgb"].copy().view(np.uint32)
    np.testing.assert_array_equal(np.stack([bits >> 16, bits >> 8 & 0xFF, bits & 0xFF], axis=1), cloud.colour)
    np.testing.assert_array_equal(points["sigma"], cloud.sigma_m)
    np.testing.assert_array_equal(points["observations"], cloud.observations)


READ_COLMAP = """
import json, sys, pycolmap
r = pycolmap.Reconstruction(sys.argv[1])
image = r.images[2]
camera = r.cameras[1]
point = r.points3D[1].xyz
print(json.dumps({
    "images": len(r.images), "points": len(r.points3D), "name": image.name, "model": camera.model.name,
    "centre": image.projection_center().tolist(), "xyz": point.tolist(),
    "pixel": image.project_point(point).tolist(),
}))
"""


@pytest.mark.parametrize("camera", [PRESETS["tum_fr1"], PRESETS["kinect"]], ids=["distorted", "pinhole"])
def test_colmap_reads_the_model_and_projects_as_we_do(camera, cloud, tmp_path):
    if importlib.util.find_spec("pycolmap") is None:
        pytest.skip("pycolmap is not installed: the COLMAP model is not read by COLMAP")
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, :3, 3] = [0.1, -0.2, -3.0]
    write_colmap(tmp_path, camera, ["a.jpg", "b c.jpg"], T, cloud)
    # In its own process: pycolmap and OpenCV each bring a zlib, and both in one process crash.
    command = [sys.executable, "-c", READ_COLMAP, str(tmp_path)]
    found = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    assert (found["images"], found["points"], found["name"]) == (2, 50, "b_c.jpg")
    assert found["model"] == ("FULL_OPENCV" if camera.is_distorted else "PINHOLE")
    np.testing.assert_allclose(found["centre"], T[1, :3, 3], atol=1e-9)
    p_c = np.asarray(found["xyz"]) - T[1, :3, 3]
    ours = cv2.projectPoints(p_c.reshape(1, 3), np.zeros(3), np.zeros(3), camera.K, np.array(camera.distortion))[0]
    np.testing.assert_allclose(np.array(found["pixel"]) - 0.5, ours.reshape(2), atol=1e-3)


def wall_at(x, half_m=1.0):
    y = np.linspace(-half_m, half_m, 400)
    return np.stack([np.full(400, x), y, np.tile([0.9, 1.1], 200)], axis=1)


def seen_from(eye, p_w, sigma_m=0.01):
    return SightLines(np.broadcast_to(np.array(eye), p_w.shape), p_w, np.full(len(p_w), sigma_m))


def value_at(grid, x, y):
    column = int((x - grid.origin[0]) / grid.resolution_m)
    row = int((y - grid.origin[1]) / grid.resolution_m)
    return int(grid.cells[grid.cells.shape[0] - 1 - row, column])


def test_occupancy_grid_has_walls_where_they_are(tmp_path):
    wall = wall_at(2.02)
    floor = np.stack([np.linspace(0.3, 1.9, 400), wall[:, 1], np.zeros(400)], axis=1)  # below the heights
    p_w = np.concatenate([wall, floor])
    write_occupancy(tmp_path / "m", occupancy_grid(p_w, seen_from((0.0, 0.0, 1.0), wall), np.array([[0.0, 0.0, 1.0]])))
    record = yaml.safe_load((tmp_path / "m.yaml").read_text())
    image = cv2.imread(str(tmp_path / record["image"]), cv2.IMREAD_UNCHANGED)
    assert record["resolution"] == 0.05 and record["negate"] == 0
    grid = OccupancyGrid(image, record["resolution"], tuple(record["origin"][:2]), (0.5, 1.5))
    assert value_at(grid, 2.02, 0.0) == OCCUPIED and value_at(grid, 2.02, 0.9) == OCCUPIED
    assert value_at(grid, 1.0, 0.0) == FREE and value_at(grid, 1.5, 0.3) == FREE
    assert value_at(grid, 1.0, -0.9) == UNKNOWN, "nothing was seen there"
    columns = np.flatnonzero((image == OCCUPIED).any(axis=0))
    assert len(columns) == 1, "the wall is one cell thick"


def test_bare_wall_with_edges_behind_it_is_not_free():
    """A wall without edges at 1 m hides edges at 3 m, which were seen from the other room alone: nobody looked
    through the wall, so neither it nor the space behind it is free, seen from here."""
    beside, behind = wall_at(1.0)[:20], wall_at(3.0)
    perception = np.array([[0.0, 0.0, 1.0], [2.0, 0.0, 1.0]])
    here, there = seen_from((0.0, 0.0, 1.0), beside), seen_from((2.0, 0.0, 1.0), behind)
    lines = SightLines(*(np.concatenate(pair) for pair in zip(astuple(here), astuple(there), strict=True)))
    grid = occupancy_grid(np.concatenate([beside, behind]), lines, perception)
    assert value_at(grid, 1.0, 0.0) == UNKNOWN, "the bare wall"
    assert value_at(grid, 0.5, 0.0) == UNKNOWN, "nothing says how far the bare wall is"
    assert value_at(grid, 0.5, -0.47) == FREE, "before what was seen of the wall"
    assert value_at(grid, 2.5, 0.0) == FREE and value_at(grid, 3.0, 0.0) == OCCUPIED


@pytest.mark.parametrize(
    ("sigma_m", "x", "expected"), [(0.05, 1.7, FREE), (0.25, 1.7, UNKNOWN), (0.25, 1.3, FREE), (np.nan, 1.0, UNKNOWN)]
)
def test_space_is_free_up_to_two_sigma_before_what_was_seen(sigma_m, x, expected):
    wall = wall_at(2.0)
    grid = occupancy_grid(wall, seen_from((0.0, 0.0, 1.0), wall, sigma_m), np.array([[0.0, 0.0, 1.0]]))
    assert value_at(grid, x, 0.0) == expected


@pytest.mark.parametrize("far_m", [1e7, np.inf])
def test_line_of_sight_that_leaves_the_grid_costs_no_more_memory_than_one_that_ends_in_it(far_m):
    wall = np.concatenate([wall_at(2.0), [[far_m, 0.8, 1.0]]])
    grid = occupancy_grid(wall_at(2.0), seen_from((0.0, 0.8, 1.0), wall), np.array([[0.0, 0.8, 1.0]]))
    assert value_at(grid, 1.0, 0.8) == FREE and grid.cells.shape == (44, 44)


def test_grid_without_sight_lines_is_free_where_the_camera_was():
    none = np.zeros((0, 3))
    lines = SightLines(none, none, np.zeros(0))
    grid = occupancy_grid(wall_at(2.0), lines, np.array([[0.0, 0.0, 1.0]]))
    assert value_at(grid, 0.0, 0.0) == FREE
    assert np.count_nonzero(grid.cells == FREE) == 1


@pytest.fixture
def run(run_folder, tmp_path):
    """A run's folder with its camera."""
    run_folder(tmp_path / "a")
    save_camera(tmp_path / "a" / "camera.yaml", PRESETS["kinect"])
    return tmp_path / "a"


def export(*words):
    parser = argparse.ArgumentParser()
    export_map.add_arguments(parser)
    return export_map.main(parser.parse_args([str(w) for w in words]))


@pytest.mark.parametrize("form", [form for form in export_map.FORMATS if form != "nerfstudio"])
def test_command_writes_every_format(form, run, capsys):
    before = set(run.rglob("*"))
    assert export(run, "--format", form, "--max-sigma", 0.05) == 0
    assert set(run.rglob("*")) > before
    assert form != "colmap" or "points are not linked to images" in capsys.readouterr().out, "the run kept none"


@pytest.mark.parametrize(
    ("words", "summary", "said"),
    [
        ("nerfstudio", {}, r"images of the keyframes are not there; .*--keep-images"),
        ("occupancy", {"scale": {"value": 1.0, "sigma": 0.03, "units": "arbitrary"}}, "metric scale"),
        ("ply --max-sigma 1e-9", {}, "no point is left"),
        ("occupancy", None, "edge map is empty"),
    ],
)
def test_what_cannot_be_exported_says_why(words, summary, said, run, cloud):
    if summary is None:
        write_ply(run / "edge_map.ply", PointCloud(*(column[:0] for column in astuple(cloud))))
    with_summary(run, **(summary or {}))
    with pytest.raises(EdgeSlamError, match=said):
        export(run, "--format", *words.split())


@pytest.mark.parametrize("summary", ['{"scale": null}', '{"scale": {}}', "{}"])
def test_unknown_units_are_said(summary, run, capsys):
    (run / "summary.json").write_text(summary)
    assert export(run, "--format", "ply") == 0
    assert "the folder does not say" in capsys.readouterr().out


@pytest.mark.parametrize("options", [[], ["--overwrite"]])
def test_nerfstudio_replaces_no_picture_of_the_recording(options, run, tmp_path):
    with_summary(run, source={"path": "../flight"})
    picture = tmp_path / "flight" / "images" / "00001.png"
    picture.parent.mkdir(parents=True)
    picture.touch()
    with pytest.raises(OutputError, match="give another file to --out"):
        export(run, "--format", "nerfstudio", "--out", tmp_path / "flight", *options)


def test_maps_are_not_added_to_pictures_of_others(run, tmp_path):
    theirs = tmp_path / "pictures"
    theirs.mkdir()
    for i in range(4):
        (theirs / f"{i}.png").touch()
    with pytest.raises(OutputError):
        export(run, "--format", "occupancy", "--out", theirs / "map")
    assert len(list(theirs.iterdir())) == 4
    for name in "abcd":
        export(run, "--format", "occupancy", "--out", run / name)
        export(run, "--format", "occupancy", "--out", tmp_path / name)


@pytest.mark.parametrize("form", export_map.FORMATS)
def test_no_file_of_a_folder_that_is_no_run_is_replaced_unasked(form, run):
    for name in ("status.csv", "summary.json"):
        (run / name).unlink()
    names = {"ply": "export.ply", "las": "edge_map.las", "pcd": "edge_map.pcd", "colmap": "colmap/images.txt"}
    path = run / names.get(form, {"nerfstudio": "nerfstudio/transforms.json"}.get(form, "occupancy.yaml"))
    path.parent.mkdir(exist_ok=True)
    path.write_text("precious")
    with pytest.raises(OutputError):
        export(run, "--format", form, "--z-is-up")
    assert path.read_text() == "precious"


@pytest.mark.parametrize("up", [None, {"source": "unknown", "sigma_deg": None}])
def test_occupancy_of_a_possibly_tilted_map_needs_an_option(up, run):
    with_summary(run, up=up)
    with pytest.raises(EdgeSlamError, match="--z-is-up"):
        export(run, "--format", "occupancy")
    assert export(run, "--format", "occupancy", "--z-is-up") == 0
    with_summary(run, up={"source": "edges", "sigma_deg": 2.0})
    assert export(run, "--format", "occupancy") == 0


KNOWN = {"source": "edges", "sigma_deg": 1.24}


@pytest.mark.parametrize(
    ("form", "file", "up"),
    [
        *[(*form, up) for form in (("pcd", ""), ("las", ""), ("colmap", "points3D.txt")) for up in (KNOWN, None)],
        *[("ply", "", up) for up in (KNOWN, {"source": "unknown", "sigma_deg": None}, {"source": 3, "sigma_deg": "x"})],
    ],
)
def test_every_exported_map_says_whether_z_is_up(run, tmp_path, capsys, form, file, up):
    if form == "las":
        pytest.importorskip("laspy")
    said = "z up by edges, sigma 1.2 degrees" if up is KNOWN else "up is not known"
    assert export(with_summary(run, up=up), "--format", form, "--out", tmp_path / "out") == 0
    assert said in capsys.readouterr().out
    assert said.encode() in (tmp_path / "out" / file if file else tmp_path / "out").read_bytes()[:10000]


def test_plyfile_reads_what_was_written(cloud, tmp_path):
    plyfile = pytest.importorskip("plyfile", reason="plyfile is not installed")
    write_ply(tmp_path / "m.ply", cloud)
    found = plyfile.PlyData.read(tmp_path / "m.ply")["vertex"]
    np.testing.assert_array_equal(np.stack([found[k] for k in "xyz"], axis=1), cloud.p_w)
    np.testing.assert_array_equal(np.stack([found[k] for k in ("red", "green", "blue")], axis=1), cloud.colour)
    np.testing.assert_array_equal(found["sigma"], cloud.sigma_m)
    np.testing.assert_array_equal(found["observations"], cloud.observations)


def test_sight_above_the_heights_frees_nothing():
    wall = wall_at(2.0)
    lamps = wall + [0.0, 0.0, 2.0]  # seen at 45 degrees upwards: the ray leaves the heights half a metre ahead
    grid = occupancy_grid(np.concatenate([wall, lamps]), seen_from((0.0, 0.0, 1.0), lamps), np.array([[0.0, 0.0, 1.0]]))
    assert value_at(grid, 0.35, 0.0) == FREE
    assert value_at(grid, 1.0, 0.0) == UNKNOWN
