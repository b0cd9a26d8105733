"""Variants of a recording, frame by frame, on numbered images."""

import numpy as np
import pytest

from edgeslam_torch.eval.judge import sources
from edgeslam_torch.eval.judge.cells import VARIANTS, Variant
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.camera_file import save_camera
from edgeslam_torch.readers.layouts import read_sequence
from edgeslam_torch.readers.source import open_source

CAMERA = Camera(64, 48, 60.0, 61.0, 31.5, 23.5)


@pytest.fixture
def numbered():
    """Twenty images at 10 Hz, each of the grey value of its number."""
    return sources.made_of(lambda i: np.full((48, 64, 3), i, np.uint8), 20, CAMERA, 10.0)


def seen(recording):
    return [(f.index, round(f.stamp_s, 3), int(f.image[0, 0, 0])) for f in recording.frames()]


def test_variant_starts_first_and_then_thins(numbered):
    variant = Variant(first=5, rate=2)
    assert [image for _, _, image in seen(variant.applied_to(numbered))] == list(range(5, 20, 2))
    assert variant.frames_of(20) == 8


def test_half_size_shrinks_images_and_camera_alike(rng):
    image = rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)
    small = sources.smaller(sources.made_of(lambda _: image, 1, CAMERA, 10.0), 2)
    frame = next(iter(small.frames()))
    blocks = image.reshape(24, 2, 32, 2, 3).mean(axis=(1, 3))
    assert np.abs(frame.image - blocks).max() <= 0.5, "the mean of two by two pixels"
    assert (small.camera.width, small.camera.height, small.camera.fx) == (32, 24, 30.0)
    # Pixel centres at integers: pixel 0 of the small image lies between pixels 0 and 1 of the large one.
    point = np.array([[0.1, 0.2, 2.0]])
    assert small.camera.project(point) == pytest.approx((CAMERA.project(point) - 0.5) / 2)


def test_wrong_focal_length_changes_nothing_but_the_calibration(numbered):
    wrong = sources.with_focal_length(numbered, 1.03)
    assert (wrong.camera.fx, wrong.camera.fy) == pytest.approx((61.8, 62.83))
    assert (wrong.camera.cx, wrong.camera.cy) == (CAMERA.cx, CAMERA.cy)
    assert seen(wrong) == seen(numbered)


def test_half_size_of_jpeg_files_has_grey_and_colour_of_one_size(tmp_path, write_images):
    write_images(tmp_path / "rgb", ["1.000000.jpg", "1.100000.jpg"], (64, 48))
    (tmp_path / "rgb.txt").write_text("1.0 rgb/1.000000.jpg\n1.1 rgb/1.100000.jpg\n")
    save_camera(tmp_path / "camera.yaml", CAMERA)
    frames = list(VARIANTS["half_size"].applied_to(open_source(tmp_path)).frames())
    assert [f.grey.shape for f in frames] == [(24, 32)] * 2
    assert [f.image.shape[:2] for f in frames] == [(24, 32)] * 2
    assert frames[0].path.name == "1.000000.jpg"


def test_a_perturbation_is_drawn_by_the_seed_and_far_below_a_pixel(numbered):
    variant = Variant(perturb_px=0.01)
    first, second = (variant.applied_to(numbered, seed) for seed in (1, 2))
    assert [image for _, _, image in seen(first)] == list(range(1, 20))
    assert [image for _, _, image in seen(second)] == list(range(2, 20))
    names = ("fx", "fy", "cx", "cy")
    moves = [abs(getattr(one.camera, k) - getattr(CAMERA, k)) for one in (first, second) for k in names]
    assert min(moves) > 0.0 and max(moves) < 0.05
    assert first.camera != second.camera and variant.applied_to(numbered, 1).camera == first.camera


@pytest.mark.parametrize(
    ("order", "numbers", "stamps"),
    [
        (sources.backwards, [2, 1, 0], [1.0, 1.2, 1.3]),
        (lambda t: sources.cut(t, [[0, 2], [2, 3], [0, 2]]), [0, 1, 2, 0, 1], [1.0, 1.15, 1.3, 1.45, 1.6]),
    ],
)
def test_images_in_another_order_are_numbered_and_stamped_anew(tmp_path, write_images, order, numbers, stamps):
    names = ["1.000000.png", "1.100000.png", "1.300000.png"]
    write_images(tmp_path / "rgb", names, (64, 48))
    (tmp_path / "rgb.txt").write_text("".join(f"{n[:-4]} rgb/{n}\n" for n in names))
    save_camera(tmp_path / "camera.yaml", CAMERA)
    images = read_sequence(tmp_path).images
    played = order(np.array([image.stamp_s for image in images]))
    frames = list(sources.reordered(open_source(tmp_path), images, *played).frames())
    assert [f.path.name for f in frames] == [names[k] for k in numbers]
    assert [f.index for f in frames] == list(range(len(numbers)))
    assert [f.stamp_s for f in frames] == pytest.approx(stamps)
