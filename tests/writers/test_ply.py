import numpy as np
import pytest

from edgeslam_torch.errors import SourceError
from edgeslam_torch.types import PointCloud
from edgeslam_torch.writers.ply import read_ply, write_ply


@pytest.fixture
def cloud(rng):
    return PointCloud(
        rng.normal(size=(50, 3)).astype(np.float32),
        rng.integers(0, 256, (50, 3), dtype=np.uint8),
        rng.random(50).astype(np.float32),
        rng.integers(1, 99, 50, dtype=np.int32),
    )


def test_round_trip_is_exact(tmp_path, cloud):
    write_ply(tmp_path / "c.ply", cloud, ("units: metres",))
    back = read_ply(tmp_path / "c.ply")
    for name in ("p_w", "colour", "sigma_m", "observations"):
        np.testing.assert_array_equal(getattr(back, name), getattr(cloud, name))


def test_ascii_file_of_another_program(tmp_path):
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty double x\nproperty double y\nproperty double z\n"
        "element face 0\nproperty list uchar int vertex_indices\nend_header\n1 2 3\n4 5 6\n"
    )
    cloud = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(cloud.p_w, [[1, 2, 3], [4, 5, 6]])
    assert np.isinf(cloud.sigma_m).all()


@pytest.mark.parametrize(
    "damage",
    [
        lambda b: b[:-10],
        lambda b: b.replace(b"end_header", b"end_hexder"),
        lambda b: b.replace(b"little", b"big"),
        lambda b: b.replace(b"property float x", b"property blob x"),
        lambda b: b.replace(b"property float x", b"property float y"),
        lambda b: b.replace(b"property float x", b"property float q"),
        lambda b: b.replace(b"vertex ", b"vertex " + b"9" * 5000),
    ],
)
def test_damaged_file_is_refused_by_name(tmp_path, cloud, damage):
    path = tmp_path / "c.ply"
    write_ply(path, cloud)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(SourceError, match="c.ply"):
        read_ply(path)


def test_layout_is_what_the_header_says(tmp_path, cloud):
    write_ply(tmp_path / "c.ply", cloud)
    header, _, body = (tmp_path / "c.ply").read_bytes().partition(b"end_header\n")
    assert b"format binary_little_endian 1.0\n" in header
    assert b"element vertex 50\n" in header
    assert len(body) == 50 * (12 + 3 + 4 + 4)
    np.testing.assert_array_equal(np.frombuffer(body[:12], "<f4"), cloud.p_w[0])


def test_empty_cloud(tmp_path):
    empty = PointCloud(
        np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, np.float32), np.zeros(0, int)
    )
    write_ply(tmp_path / "c.ply", empty)
    assert read_ply(tmp_path / "c.ply").p_w.shape == (0, 3)
