import numpy as np
import pytest

from edgeslam_torch.drone.emulator import room
from edgeslam_torch.drone.emulator.stopwatch import draw_time, read_time
from edgeslam_torch.synthetic.sites.build import named_site


@pytest.mark.parametrize("time_s", [0.0, 0.001, 12.345, 65.535])
def test_a_time_is_read_back_from_a_noisy_picture(rng, time_s):
    image = rng.integers(0, 256, (240, 320, 3), dtype=np.uint8)
    draw_time(image, time_s)
    noisy = np.clip(image + rng.normal(0, 25, image.shape), 0, 255).astype(np.uint8)
    assert read_time(noisy) == pytest.approx(time_s)


def test_the_room_is_painted_where_the_drone_is(monkeypatch):
    monkeypatch.setattr(room, "place", lambda name, rng: named_site("blank_walls", 0).world)  # built ten times as fast
    drone, paint, camera = room.furnished_drone(0, 0.2, (160, 120))
    first = paint(drone.T_w_b())
    assert first.shape == (120, 160, 3)
    assert camera.width == 160
    drone.p_w = drone.p_w + [0.3, 0.0, 0.8]
    assert np.abs(paint(drone.T_w_b()).astype(float) - first).mean() > 3.0
    assert drone.clearance(drone.p_w) > 0.0


def test_a_picture_without_a_stopwatch_shows_no_time(rng):
    assert read_time(rng.integers(0, 256, (720, 960, 3), dtype=np.uint8)) is None
    assert read_time(np.full((720, 960, 3), 90, np.uint8)) is None
