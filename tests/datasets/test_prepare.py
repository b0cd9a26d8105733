"""Recordings in axes and lists of their own become ones that our readers take; checked by projecting points."""

import numpy as np
import pytest
from published import png
from scipy.spatial.transform import Rotation

from edgeslam_torch.datasets.prepare import prepare_icl, prepare_tartanair
from edgeslam_torch.errors import SourceError
from edgeslam_torch.eval.inputs.dataset import open_dataset
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera_file import load_camera


def pose(rng):
    """A random pose as ``t`` and ``(x, y, z, w)``."""
    return rng.normal(size=3), Rotation.random(random_state=int(rng.integers(1 << 30))).as_quat()


def line(*numbers):
    return " ".join(f"{x:.9f}" for x in numbers)


def write_icl(folder, poses):
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
        for i in range(len(poses) + 1):  # frame 0 has no pose
            (folder / name / f"{i}.png").write_bytes(png(i, np.uint8 if name == "rgb" else np.uint16))
    (folder / "livingRoom0.gt.freiburg").write_text(
        "".join(f"{i} {line(*t, *q)}\n" for i, (t, q) in enumerate(poses, start=1))
    )


def test_icl_points_fall_on_the_pixels_that_its_own_camera_states(rng, tmp_path):
    # https://www.doc.ic.ac.uk/~ahanda/VaFRIC/codes.html: K has fy = -480.
    K = np.array([[481.2, 0, 319.5], [0, -480.0, 239.5], [0, 0, 1]])
    poses = [pose(rng) for _ in range(12)]
    write_icl(tmp_path, poses)
    prepare_icl(tmp_path, None)
    dataset = open_dataset(tmp_path)
    camera = load_camera(tmp_path / "camera.yaml")
    assert len(dataset.frame_stamps_s) == 13
    np.testing.assert_allclose(dataset.truth.stamps_s, np.arange(1, 13) / 30, atol=1e-6)
    for (t, q), T_w_c in zip(poses, dataset.truth.T_w_c, strict=True):
        p_theirs = rng.uniform([-1, -1, 2], [1, 1, 5])
        uvw = K @ p_theirs
        p_world = Rotation.from_quat(q).apply(p_theirs) + t
        p_ours = se3.transform(se3.inverse(T_w_c), (p_world * [1, -1, 1])[None])  # the world's y is turned too
        np.testing.assert_allclose(camera.project(p_ours)[0], uvw[:2] / uvw[2], atol=1e-3)
        assert np.linalg.det(T_w_c[:3, :3]) == pytest.approx(1.0), "a rotation, no mirror"
    assert dataset.depth is not None
    assert dataset.depth.metres_per_unit == pytest.approx(1 / 5000)


def test_tartanair_camera_looks_along_the_first_axis_of_its_poses(tmp_path):
    for i in range(3):
        (tmp_path / f"{i:06d}.png").write_bytes(png(i))
    # North, east, down: one metre forward a frame while the camera looks north; then it has turned to the east.
    east = Rotation.from_euler("z", 90, degrees=True).as_quat()  # about down, to the right
    rows = [line(0, 0, -1, 0, 0, 0, 1), line(1, 0, -1, 0, 0, 0, 1), line(1, 0, -1, *east)]
    prepare_tartanair(tmp_path, "\n".join(rows).encode())
    truth = open_dataset(tmp_path).truth
    T0, T1, T2 = truth.T_w_c
    assert T0[2, 3] == pytest.approx(1.0), "z is up: one metre above the ground"
    np.testing.assert_allclose(se3.transform(se3.inverse(T0), T1[None, :3, 3]), [[0, 0, 1]], atol=1e-6)
    np.testing.assert_allclose((np.linalg.inv(T1) @ T2)[:3, :3] @ [0, 0, 1], [1, 0, 0], atol=1e-6, err_msg="right")
    np.testing.assert_allclose(truth.stamps_s, [0, 0.05, 0.1], atol=1e-6)


@pytest.mark.parametrize("truth", [None, b"1 2 3\n", b"a b c d e f g\n", b"0 0 0 0 0 0 1\n", b"\xff\xfe"])
def test_truth_that_does_not_fit_is_refused(tmp_path, truth):
    for i in range(2):
        (tmp_path / f"{i:06d}.png").write_bytes(png(i))
    with pytest.raises(SourceError):
        prepare_tartanair(tmp_path, truth)
