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


@pytest.mark.parametrize("count", [50, 0])
def test_round_trip_is_exact_and_the_layout_is_what_the_header_says(tmp_path, cloud, count):
    names = ("p_w", "colour", "sigma_m", "observations")
    written = PointCloud(*(getattr(cloud, name)[:count] for name in names))
    write_ply(tmp_path / "c.ply", written, ("units: metres",))
    back = read_ply(tmp_path / "c.ply")
    for name in names:
        np.testing.assert_array_equal(getattr(back, name), getattr(written, name))
    header, _, body = (tmp_path / "c.ply").read_bytes().partition(b"end_header\n")
    assert b"format binary_little_endian 1.0\n" in header
    assert f"element vertex {count}\n".encode() in header
    assert len(body) == count * (12 + 3 + 4 + 4)
    np.testing.assert_array_equal(np.frombuffer(body[:12], "<f4"), written.p_w[:1].ravel())


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
