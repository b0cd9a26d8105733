"""README's table by one command, from a publisher on this machine with the layouts of the real ones."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from published import tgz, zipped

from edgeslam_torch.cli import main
from edgeslam_torch.datasets import catalogue
from edgeslam_torch.eval.inputs.trajectory_files import read_trajectory
from edgeslam_torch.geometry import se3

EUROC_MOUNT = np.array(
    [
        [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975],
        [0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768],
        [-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
"""``T_BS`` of EuRoC's cam0: the copies' true poses are the camera's, those of the publisher the body's."""


def archives(data, frames):
    """Name in the catalogue and content of each archive.

    Args:
        data: Folder of the copies.
        frames: Of each recording, from its start.
    """
    for name, copy, folder, faster in (
        ("tum_fr1_xyz", "tum_fr1_xyz", "rgbd_dataset_freiburg1_xyz", 1.0),
        ("tum_fr1_rpy", "tum_fr1_rpy_depth", "rgbd_dataset_freiburg1_rpy", 3.0),  # every third frame, here at 30 Hz
        ("tum_fr3_structure_notexture_far", "fr3_notexture_a", "rgbd_dataset_freiburg3_structure_notexture_far", 1.0),
    ):
        yield name, tgz(_tum(data / copy, folder, frames, faster))
    yield "7scenes_redkitchen/seq-01", zipped({"redkitchen/seq-01.zip": zipped(_scene(data, frames))})
    inside = "machine_hall/MH_05_difficult/MH_05_difficult.zip"
    yield "euroc_mh_05", zipped({inside: zipped(_euroc(data / "euroc_mh05_a", frames))})


def _list(path):
    lines = [line.split() for line in path.read_text().splitlines() if line and not line.startswith("#")]
    return [(float(stamp), name) for stamp, name in lines]


def _tum(copy, folder, frames, faster):
    images = _list(copy / "rgb.txt")[:frames]
    begin, end = images[0][0], images[-1][0]
    files = {}
    for kind, rows in (("rgb", images), ("depth", [row for row in _list(copy / "depth.txt") if row[0] <= end + 0.1])):
        lines = "".join(f"{begin + (stamp - begin) / faster:.6f} {name}\n" for stamp, name in rows)
        files[f"{folder}/{kind}.txt"] = f"# timestamp filename\n{lines}".encode()
        files |= {f"{folder}/{name}": (copy / name).read_bytes() for _, name in rows}
    truth = [line.split() for line in (copy / "groundtruth.txt").read_text().splitlines() if line[0] != "#"]
    poses = "".join(f"{begin + (float(t) - begin) / faster:.4f} {' '.join(pose)}\n" for t, *pose in truth)
    return files | {f"{folder}/groundtruth.txt": poses.encode()}


def _scene(data, frames):
    copy = data / "7scenes_redkitchen"
    depth = {round(30 * stamp): copy / name for stamp, name in _list(copy / "depth.txt")}
    truth = read_trajectory(copy / "groundtruth.txt")
    files = {}
    for number, (_, name) in enumerate(_list(copy / "rgb.txt")[:frames]):
        here = f"seq-01/frame-{number:06d}"
        files[f"{here}.color.png"] = _png(copy / name)
        files[f"{here}.pose.txt"] = "\n".join("\t ".join(map(str, row)) for row in truth.T_w_c[number]).encode()
        if number in depth:
            files[f"{here}.depth.png"] = depth[number].read_bytes()
    return files


def _euroc(copy, frames):
    images = _list(copy / "rgb.txt")[:frames]
    numbers = [Path(name).stem for _, name in images]
    rows = "".join(f"{number},{number}.png\r\n" for number in numbers)
    files = {f"mav0/cam0/data/{Path(name).stem}.png": _png(copy / name) for _, name in images}
    files["mav0/cam0/data.csv"] = f"#timestamp [ns],filename\r\n{rows}".encode()
    files["mav0/cam0/sensor.yaml"] = _euroc_sensor(yaml.safe_load((copy / "camera.yaml").read_text())).encode()
    files["mav0/state_groundtruth_estimate0/data.csv"] = _euroc_truth(read_trajectory(copy / "groundtruth.txt"))
    return files


def _euroc_sensor(camera):
    return (
        "#Default imu sensor yaml file\nsensor_type: camera\ncomment: VI-Sensor cam0 (MT9M034)\n\n"
        f"T_BS:\n  cols: 4\n  rows: 4\n  data: {EUROC_MOUNT.ravel().tolist()}\n\n"
        f"rate_hz: 20\nresolution: [{camera['width']}, {camera['height']}]\ncamera_model: pinhole\n"
        f"intrinsics: {[camera[key] for key in ('fx', 'fy', 'cx', 'cy')]}\n"
        f"distortion_model: radial-tangential\ndistortion_coefficients: {camera['distortion'][:4]}\n"
    )


def _euroc_truth(camera):
    def row(stamp, T):
        x, y, z, *q = se3.pose_to_tum(T @ np.linalg.inv(EUROC_MOUNT))
        return ",".join([f"{stamp * 1e9:.0f}", *(f"{v:.6f}" for v in (x, y, z, q[3], *q[:3])), *["0"] * 9])

    rows = [row(stamp, T) for stamp, T in zip(camera.stamps_s, camera.T_w_c, strict=True)]
    return ("#timestamp, p_RS_R_x [m]\r\n" + "\r\n".join(rows) + "\r\n").encode()


def _png(path):
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    return cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()


FRAMES = 60
"""Of each recording: two to six seconds."""


def publish(publisher, data, frames):
    """The catalogue's recordings with this publisher's addresses, whose archives are shorter than the real ones."""
    recordings = dict(catalogue.read_catalogue()[0])
    for name, content in archives(data, frames):
        at = f"/{name.replace('/', '_')}"
        publisher.files[at] = content
        here = {"urls": (publisher.address + at,), "size": 0, "is_exact": False, "checksum": "", "checksum_by": ""}
        recordings[name] = replace(recordings[name], archive=replace(recordings[name].archive, **here))
    return recordings


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.timeout(1200)
def test_one_command_fetches_runs_and_judges_what_readme_quotes(publisher, data_dir, tmp_path, monkeypatch, capsys):
    pytest.importorskip("pooch", reason="needs the [data] extra: pooch is not installed")
    sets = catalogue.read_catalogue()[1]
    recordings = publish(publisher, data_dir, FRAMES)
    monkeypatch.setattr(catalogue, "catalogue", lambda: (recordings, sets))
    words = ["--seeds", "1", "--data", str(tmp_path / "rec"), "--out", str(tmp_path / "out")]
    assert main(["bench", "--get", "readme", "--agree", *words]) == 0
    said = capsys.readouterr().out
    record = json.loads((tmp_path / "out" / "bench.json").read_text())
    runs = {run["sequence"]: run["figures"] for run in record["runs"]}
    assert len(runs) == len(sets["readme"]) == 5
    for name, figures in runs.items():
        assert f"### {name}\n" in said
        assert figures["ate_sim3_m"] < 0.1, name
    # EuRoC has no depth maps, and two seconds of turning on the spot may leave no map to compare.
    mapped = {name for name, figures in runs.items() if figures.get("map_median_m") is not None}
    assert {"tum_fr1_xyz", "7scenes_redkitchen_seq-01", "tum_fr3_structure_notexture_far"} <= mapped
    assert "euroc_mh_05" not in mapped
    assert runs["euroc_mh_05"]["rotation_deg"] < 20.0, "the truth is the body's, turned into the camera's"
