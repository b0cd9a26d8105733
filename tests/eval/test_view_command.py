"""``edgeslam view``: the page where it is, rerun only when asked for and only when installed."""

import argparse
import importlib.util
import webbrowser

import numpy as np
import pytest

from edgeslam_torch.commands import view
from edgeslam_torch.errors import MissingPackageError, OutputError
from edgeslam_torch.eval.inputs.run_folder import open_run
from edgeslam_torch.geometry.camera import PRESETS
from edgeslam_torch.geometry.camera_file import save_camera
from edgeslam_torch.types import FrameStatus, PointCloud, ScaleEstimate, SlamOutput

HAS_RERUN = importlib.util.find_spec("rerun") is not None


def run_view(*words):
    parser = argparse.ArgumentParser()
    view.add_arguments(parser)
    return view.main(parser.parse_args([str(w) for w in words]))


def test_page_is_made_when_missing_and_opened(run_folder, tmp_path, monkeypatch, capsys):
    run_folder(tmp_path / "a")
    opened = []
    monkeypatch.setattr(webbrowser, "open", lambda address: opened.append(address) or True)
    assert run_view(tmp_path / "a") == 0
    assert opened == [(tmp_path / "a" / "report.html").resolve().as_uri()]
    assert str(tmp_path / "a" / "report.html") in capsys.readouterr().out
    assert run_view(tmp_path / "a", "--print") == 0 and len(opened) == 1


@pytest.mark.skipif(HAS_RERUN, reason="rerun is installed here")
def test_missing_rerun_is_said_with_the_remedy(run_folder, tmp_path):
    run_folder(tmp_path / "a")
    with pytest.raises(MissingPackageError, match=r"pip install 'edgeslam-torch\[viewer\]'"):
        run_view(tmp_path / "a", "--viewer")


def recorded(path):
    """Rows of a recording by entity, as rerun's own reader gives them: component to value, ``time`` in seconds."""
    from rerun.chunk import RrdReader

    rows = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        columns = {name: batch[name].to_pylist() for name in batch.schema.names if ":" in name}
        if "time" in batch.schema.names:
            columns["time"] = [1e-9 * ns for ns in batch["time"].cast("int64").to_pylist()]
        found = rows.setdefault(str(chunk.entity_path), [])
        found += [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]
    return rows


needs_rerun = pytest.mark.skipif(not HAS_RERUN, reason="rerun is not installed: the [viewer] extra is not tried")


@needs_rerun
def test_recording_of_a_finished_run_holds_its_map_and_poses(run_folder, tmp_path):
    run_folder(tmp_path / "a")
    save_camera(tmp_path / "a" / "camera.yaml", PRESETS["kinect"])
    assert run_view(tmp_path / "a", "--save-rrd", tmp_path / "a.rrd") == 0
    rows, run = recorded(tmp_path / "a.rrd"), open_run(tmp_path / "a")
    cloud = run.cloud()
    assert cloud is not None
    points = rows["/world/edges"][0]
    np.testing.assert_allclose(points["Points3D:positions"], cloud.p_w, atol=1e-6)
    assert points["Points3D:colors"][0] == int.from_bytes([*cloud.colour[0], 255], "big")
    poses = [row for row in rows["/world/camera"] if row["Transform3D:translation"]]
    assert len(poses) == len(run.trajectory)
    last = max(poses, key=lambda row: row["time"])
    assert last["time"] == pytest.approx(np.ptp(run.trajectory.stamps_s), abs=1e-5)
    np.testing.assert_allclose(last["Transform3D:translation"][0], run.trajectory.positions[-1], atol=1e-6)
    columns = np.reshape(last["Transform3D:mat3x3"][0], (3, 3))
    np.testing.assert_allclose(columns.T, run.trajectory.T_w_c[-1, :3, :3], atol=1e-6)
    assert rows["/world/camera/image"][0]["Pinhole:resolution"] == [[640.0, 480.0]]


@needs_rerun
def test_recording_of_a_live_run_holds_pictures_plots_and_the_growing_map(tmp_path):
    from edgeslam_torch.viewer.rerun_viewer import Viewer

    viewer = Viewer("live", save=tmp_path / "live.rrd", show=False)
    viewer.camera(PRESETS["kinect"])
    scale = ScaleEstimate(1.0, 0.1, "depth")
    T = np.eye(4)
    for k in range(250):
        T[0, 3] = 0.01 * k
        status = FrameStatus.TRACKED if k < 200 else FrameStatus.LOST
        output = SlamOutput(k, 1e9 + k / 30, T, status, "", 9, 8 + k, 0.1, True, 0, scale, True, 0, {"tracking": 4.0})
        pictures = (np.full((480, 640, 3), 100, np.uint8), np.ones((5, 2)), np.ones((7, 2)), np.ones((48, 64)))
        viewer.step(output, *(pictures if k < 3 else ()))
        if k in (50, 100):
            few = slice(0, k)
            viewer.map(PointCloud(np.ones((200, 3))[few], np.zeros((200, 3), np.uint8)[few], np.ones(k), np.ones(k)))
    viewer.close()
    rows = recorded(tmp_path / "live.rrd")
    assert (
        len(rows["/world/camera/image/edges"]) == len(rows["/world/camera/image/features"]) == len(rows["/depth"]) == 3
    )
    depth = np.array(rows["/depth"][0]["DepthImage:buffer"][0], np.uint8).view("<u2")
    assert len(depth) == 24 * 32 and set(depth / rows["/depth"][0]["DepthImage:meter"][0]) == {1.0}
    assert [len(row["Points3D:positions"]) for row in rows["/world/edges"]] == [50, 100]
    assert [row["Scalars:scalars"][0] for row in rows["/plots/inliers"]] == [8 + k for k in range(250)]
    assert {"/plots/step_ms", "/scale/value", "/scale/sigma", "/status"} <= set(rows)
    assert max(row["time"] for row in rows["/plots/inliers"]) == pytest.approx(249 / 30, abs=1e-3)
    pieces = {name: values[-1]["LineStrips3D:strips"][0] for name, values in rows.items() if "/trajectory/" in name}
    longest = sorted((min(p)[0], max(p)[0]) for p in pieces.values())
    np.testing.assert_allclose([a for a, _ in longest[1:]], [b for _, b in longest[:-1]], atol=1e-6)  # joined
    assert longest[-1][1] == pytest.approx(2.49) and max(map(len, pieces.values())) <= 102, "pieces stay short"


@needs_rerun
def test_recording_that_cannot_be_written_is_said(run_folder, tmp_path):
    run_folder(tmp_path / "a")
    with pytest.raises(OutputError, match="summary.json"):
        run_view(tmp_path / "a", "--save-rrd", tmp_path / "a" / "summary.json" / "x.rrd")
