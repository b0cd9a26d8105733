"""Trajectory files are read back as written, and refused with the likely mistake when they are none."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.associate import on_one_clock
from edgeslam_torch.eval.inputs.trajectory_files import Trajectory, read_trajectory, write_tum


def euroc(trajectory, path):
    """Nanoseconds, position, quaternion with its scalar first, and nine numbers of no interest."""
    q = Rotation.from_matrix(trajectory.T_w_c[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    rows = np.c_[trajectory.positions, q, np.zeros((len(q), 9))]
    lines = [",".join([ns(t), *map(str, row)]) for t, row in zip(trajectory.stamps_s, rows, strict=True)]
    path.write_text("#timestamp [ns],px,py,pz,qw,qx,qy,qz,vx,vy,vz,bwx,bwy,bwz,bax,bay,baz\n" + "\n".join(lines) + "\n")


def kitti(trajectory, path):
    np.savetxt(path, trajectory.T_w_c[:, :3].reshape(-1, 12))
    np.savetxt(path.with_name("times.txt"), trajectory.stamps_s)


def seven_scenes(trajectory, folder):
    folder.mkdir()
    for k, T in enumerate(trajectory.T_w_c):
        np.savetxt(folder / f"frame-{k:06d}.pose.txt", T)
    np.savetxt(folder / "times.txt", trajectory.stamps_s)


@pytest.mark.parametrize("begin", [0.0, 1.3e9])
@pytest.mark.parametrize(
    ("write", "name"), [(write_tum, "poses.txt"), (euroc, "data.csv"), (kitti, "poses.txt"), (seven_scenes, "seq")]
)
def test_every_format_is_read(write, name, begin, loop, tmp_path):
    stamps = begin + np.sort(np.random.default_rng(0).uniform(0, 9, len(loop)))
    write(Trajectory(stamps, loop.T_w_c, "loop"), tmp_path / name)
    back = read_trajectory(tmp_path / name)
    assert back.stamped
    np.testing.assert_allclose(back.stamps_s, stamps, atol=1e-6)
    np.testing.assert_allclose(back.T_w_c, loop.T_w_c, atol=1e-8)


@pytest.mark.parametrize(("write", "name"), [(kitti, "poses.txt"), (seven_scenes, "seq")])
def test_stamps_beside_poses_are_as_many(write, name, loop, tmp_path):
    write(loop, tmp_path / name)
    next(tmp_path.rglob("times.txt")).write_text("0.0\n0.1\n")
    with pytest.raises(EvaluationError, match="200 poses but 2 stamps"):
        read_trajectory(tmp_path / name)


def test_frames_of_seven_scenes_without_stamps_are_those_of_its_sensor(loop, tmp_path):
    seven_scenes(loop, tmp_path / "seq")
    (tmp_path / "seq" / "times.txt").unlink()
    np.testing.assert_allclose(read_trajectory(tmp_path / "seq").stamps_s, np.arange(len(loop)) / 30.0)


def tum(path, rows):
    path.write_text("\n".join(r if isinstance(r, str) else " ".join(map(str, r)) for r in rows) + "\n")
    return path


GOOD = ["0.0 0 0 0 0 0 0 1", "0.1 1 0 0 0 0 0 1", "0.2 2 0 0 0 0 0 1"]


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([], "holds no poses"),
        (["# only a header"], "holds no poses"),
        (["frame; pose"], "no line of numbers in it, the first is 'frame pose'"),
        (["0.0 nan 0 0 0 0 0 1"], "NaN"),
        (["0.0 0 0", "1.0 0 0"], r"3 column\(s\).*header"),
        (["time x y theta", "0.0 0 0 0", "1.0 0 0 0"], "no column for z"),
        (["t [h],x,y,z", *(f"{t},0,0,0" for t in range(4))], "not known: s, ms"),
        ([f"1.7e+09 {k} 0 0 0 0 0 1" for k in range(9)], "too few digits"),
        ([f"{0.05 * k:.1f} {k} 0 0 0 0 0 1" for k in range(40)], "too few digits"),
        (["0.0 1 2 3 10 20 30 40", "0.1 1 2 3 10 20 30 40"], "unit quaternion"),
        ([*GOOD, "0.3 1 2"], "line 4 has 3 columns"),
        ([*GOOD, "0.3 one 0 0 0 0 0 1"], "line 4, column 2 is not a number"),
    ],
)
def test_what_is_no_trajectory_is_named(rows, words, tmp_path):
    with pytest.raises(EvaluationError, match=words) as caught:
        read_trajectory(tum(tmp_path / "t.txt", rows))
    assert "t.txt" in str(caught.value) and "\n" not in str(caught.value)


def test_corrected_rows_are_reported(tmp_path):
    rows = [GOOD[2], GOOD[1], GOOD[1], GOOD[0], "0.3 inf 0 0 0 0 0 1"]
    found = read_trajectory(tum(tmp_path / "t.txt", rows))
    assert found.stamps_s.tolist() == [0.0, 0.1, 0.2]
    notes = " ".join(found.notes)
    assert "not finite" in notes and "out of order" in notes and "repeat a stamp" in notes
    found = read_trajectory(tum(tmp_path / "t.txt", GOOD[::-1]))
    assert found.positions[:, 0].tolist() == [0.0, 1.0, 2.0] and "backwards" in found.notes[0]
    (tmp_path / "t.txt").write_text("\n".join([*GOOD, "0.3 1 2"]))  # killed while writing: no newline
    assert len(read_trajectory(tmp_path / "t.txt")) == 3


_MOUNT = "T_BS:\n  cols: 4\n  rows: 4\n  data: [0, -1, 0, 0.5, 1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n"
"""A camera half a metre ahead of the body, a quarter turn around its axis."""


def euroc_folder(folder, body, sensor):
    """True poses and a camera's file, as EuRoC publishes them."""
    (folder / "mav0" / "cam0").mkdir(parents=True)
    (folder / "mav0" / "cam0" / "sensor.yaml").write_text(f"%YAML:1.0\nsensor_type: camera\n{sensor}")
    truth = folder / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    truth.parent.mkdir()
    euroc(body, truth)
    return truth


def test_euroc_truth_becomes_the_cameras(loop, tmp_path):
    truth = euroc_folder(tmp_path, loop, _MOUNT)
    for place in (tmp_path, tmp_path / "mav0", truth):
        found = read_trajectory(place)
        np.testing.assert_allclose(found.positions, loop.positions + 0.5 * loop.T_w_c[:, :3, 0], atol=1e-8)
        np.testing.assert_allclose(found.T_w_c[:, :3, 0], loop.T_w_c[:, :3, 1], atol=1e-8)
    assert "cam0" in found.notes[-1], "it says so"
    (truth.parent / "sensor.yaml").write_text(_MOUNT)  # as EuRoC's vicon0: marker to body to camera
    np.testing.assert_allclose(read_trajectory(truth).T_w_c, loop.T_w_c, atol=1e-8)
    (tmp_path / "mav0" / "cam0" / "sensor.yaml").write_text("rate_hz: 20\n")
    np.testing.assert_allclose(read_trajectory(truth).T_w_c, loop.T_w_c, atol=1e-8)  # stays the body's


@pytest.mark.parametrize(
    "sensor",
    ["T_BS: 3\n", "T_BS: {data: [1, 2]}\n", _MOUNT.replace("-1", ".nan"), _MOUNT.replace("-1", "-2"), "T_BS: [\n"],
)
def test_euroc_mount_that_is_none_is_refused(sensor, loop, tmp_path):
    truth = euroc_folder(tmp_path, loop, sensor)
    with pytest.raises(EvaluationError, match=r"sensor\.yaml: T_BS"):
        read_trajectory(truth)


def named(header, order, loop, stamp, metre=1.0):
    """A table of ``loop`` with commas: its columns in any order, ``.`` for one that nobody asked for."""
    q = Rotation.from_matrix(loop.T_w_c[:, :3, :3]).as_quat()
    lines = [header]
    for t, p, r in zip(loop.stamps_s, loop.positions * metre, q, strict=True):
        words = {"t": stamp(t), ".": "7"} | {k: f"{v:.9f}" for k, v in zip("xyzabcd", (*p, *r), strict=True)}
        lines.append(",".join(words[k] for k in order))
    return "\n".join(lines) + "\n"


def ns(t):
    return f"{round(t * 1e9)}"


@pytest.mark.parametrize("begin", [0.0, 1.7e9], ids=["since start", "since 1970"])
@pytest.mark.parametrize(
    ("header", "order", "stamp", "metre"),
    [
        ("#timestamp [ns],p_x,p_y,p_z,q_w,q_x,q_y,q_z", "txyzdabc", ns, 1.0),
        (
            "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []",
            "txyzdabc",
            ns,
            1,
        ),
        ("timestamp,tx,ty,tz,qx,qy,qz,qw,lost", "txyzabcd.", str, 1.0),
        ("num,t,x,y,z,qx,qy,qz,qw", ".txyzabcd", str, 1.0),
        ("time_ms,qw,qx,qy,qz,pos_x_mm,pos_y_mm,pos_z_mm", "tdabcxyz", lambda t: f"{1e3 * t:.3f}", 1e3),
        (
            "field.header.seq,field.header.stamp,field.pose.position.x,field.pose.position.y,field.pose.position.z,"
            "field.pose.orientation.x,field.pose.orientation.y,field.pose.orientation.z,field.pose.orientation.w,"
            "field.twist.linear.x",
            ".txyzabcd.",
            str,
            1.0,
        ),
    ],
)
def test_columns_are_found_by_their_names(header, order, stamp, metre, begin, loop, tmp_path):
    loop = replace(loop, stamps_s=begin + loop.stamps_s)
    (tmp_path / "t.csv").write_text(named(header, order, loop, stamp, metre))
    found = read_trajectory(tmp_path / "t.csv")
    np.testing.assert_allclose(found.stamps_s, loop.stamps_s, atol=1e-5)
    np.testing.assert_allclose(found.T_w_c, loop.T_w_c, atol=1e-6)


def test_seconds_and_nanoseconds_in_two_columns_are_added(tmp_path):
    (tmp_path / "t.csv").write_text(
        "header.stamp.sec,header.stamp.nanosec,x,y,z\n5,250000000,1,2,3\n5,750000000,2,2,3\n"
    )
    found = read_trajectory(tmp_path / "t.csv")
    assert found.stamps_s.tolist() == [5.25, 5.75]
    assert not found.oriented and found.positions.tolist() == [[1.0, 2.0, 3.0], [2.0, 2.0, 3.0]]
    (tmp_path / "p.txt").write_text("5.25 1 2 3\n5.75 2 2 3\n")
    alone = read_trajectory(tmp_path / "p.txt")
    assert not alone.oriented and np.array_equal(alone.T_w_c, found.T_w_c)


def test_tum_vi_truth_is_found_and_becomes_the_cameras(loop, tmp_path):
    mocap = tmp_path / "mav0" / "mocap0" / "data.csv"
    mocap.parent.mkdir(parents=True)
    (tmp_path / "mav0" / "cam0").mkdir()
    (tmp_path / "mav0" / "cam0" / "sensor.yaml").write_text(_MOUNT)
    mocap.write_text(named("#timestamp [ns],p_x,p_y,p_z,q_w,q_x,q_y,q_z", "txyzdabc", loop, ns))
    for place in (tmp_path, mocap):
        found = read_trajectory(place)
        np.testing.assert_allclose(found.stamps_s, loop.stamps_s, atol=1e-6)
        np.testing.assert_allclose(found.positions, loop.positions + 0.5 * loop.T_w_c[:, :3, 0], atol=1e-6)
    mocap.write_text(mocap.read_text().split("\n", 1)[1])
    np.testing.assert_allclose(read_trajectory(mocap).T_w_c, found.T_w_c, atol=1e-6)  # by its place alone


def test_rows_of_kitti_without_times_take_those_of_as_many_poses(loop, tmp_path):
    kitti(loop, tmp_path / "poses.txt")
    (tmp_path / "times.txt").unlink()
    rows = read_trajectory(tmp_path / "poses.txt")
    np.testing.assert_allclose(on_one_clock(rows, loop)[0].stamps_s, loop.stamps_s)
    np.testing.assert_allclose(on_one_clock(loop, rows)[1].stamps_s, loop.stamps_s)
    with pytest.raises(EvaluationError, match=r"times\.txt"):
        on_one_clock(rows, loop.take(slice(0, 150)))


@pytest.mark.parametrize("number", ["nan", "inf", "1e200", "-1e300"])
def test_positions_that_are_none_are_left_out(number, tmp_path):
    path = tmp_path / "t.txt"
    path.write_text("".join(f"{i} {number if i == 4 else i} 0 0 0 0 0 1\n" for i in range(9)))
    trajectory = read_trajectory(path)
    assert trajectory.stamps_s.tolist() == [0, 1, 2, 3, 5, 6, 7, 8]
    path.write_text("".join(f"{i} {number} 0 0 0 0 0 1\n" for i in range(9)))
    with pytest.raises(EvaluationError, match="every pose"):
        read_trajectory(path)
