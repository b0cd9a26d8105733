import cv2
import numpy as np

from edgeslam_torch.frontend.repeats import RepeatedImages


def room(rng, size=(240, 320)):
    """A smooth image with sensor noise."""
    return np.clip(cv2.GaussianBlur(rng.normal(0, 400, size), (0, 0), 6) + 128, 0, 255).astype(np.uint8)


def noisy(rng, picture, sigma):
    return np.clip(np.rint(picture + rng.normal(0, sigma, picture.shape)), 0, 255).astype(np.uint8)


def seen(images, rate_hz=30.0):
    repeats = RepeatedImages()
    return [repeats.repeats(image, 100.0 + i / rate_hz) for i, image in enumerate(images)], repeats.warning()


def test_a_frozen_video_is_recognised_from_its_second_image_on(rng):
    picture = room(rng)
    found, warning = seen([picture] * 150)
    assert found == [False, *[True] * 149]
    assert "froze from 0.0 to 5.0 s" in warning


def test_a_camera_at_rest_is_no_frozen_video(rng):
    """Noise never repeats: half a grey level is enough."""
    picture = room(rng)
    found, warning = seen([noisy(rng, picture, 0.5) for _ in range(60)])
    assert not any(found)
    assert warning is None


def test_a_motion_too_slow_for_two_images_adds_up(rng):
    picture = room(rng)
    x, y = (a.astype(np.float32) for a in np.meshgrid(np.arange(320), np.arange(240)))
    images = [cv2.remap(picture, x + 0.02 * i, y, cv2.INTER_LINEAR) for i in range(100)]
    assert float(np.abs(images[1].astype(int) - images[0])[::4, ::4].mean()) < 0.3
    found, _ = seen(images)
    runs = np.diff(np.flatnonzero(np.logical_not(found)))
    assert runs.max() < 30


def test_a_static_image_is_recognised_after_encoding(rng, tmp_path):
    """A re-encoded frozen video differs in single bits."""
    path = str(tmp_path / "frozen.mp4")
    writer = cv2.VideoWriter(path, cv2.VideoWriter_fourcc(*"mp4v"), 30.0, (320, 240))
    assert writer.isOpened()
    picture = cv2.cvtColor(noisy(rng, room(rng), 2.0), cv2.COLOR_GRAY2BGR)
    for _ in range(90):
        writer.write(picture)
    writer.release()
    capture, images = cv2.VideoCapture(path), []
    while (read := capture.read())[0]:
        images.append(cv2.cvtColor(read[1], cv2.COLOR_BGR2GRAY))
    assert len(images) == 90
    assert not all((a == b).all() for a, b in zip(images, images[1:], strict=False))
    found, warning = seen(images)
    assert np.mean(found) > 0.9
    assert "froze" in warning


def test_copies_made_for_the_frame_rate_are_named_without_a_warning(rng):
    """12 images per second shown at 24; a Kinect that drops images repeats some 10 %."""
    images = [noisy(rng, room(rng), 1.0) for _ in range(12)]
    found, warning = seen([image for image in images for _ in range(2)], 24.0)
    assert found == [False, True] * 12
    assert warning is None
