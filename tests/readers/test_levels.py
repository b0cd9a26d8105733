import numpy as np
import pytest

from edgeslam_torch.readers.levels import Levels, levels_of

GREY = np.random.default_rng(0).integers(0, 256, (48, 64)).astype(np.float64)
GREY[0, :2] = 0, 255


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_of_values_that_fill_their_bits_the_highest_eight_are_kept(bits):
    deep = (GREY * 2 ** (bits - 8)).astype(np.uint16)
    levels = levels_of([deep])
    assert np.array_equal(levels.eight_bits(deep), GREY)
    brightest = np.full((1, 1), 65535, np.uint16)
    assert levels.eight_bits(brightest) == 255


@pytest.mark.parametrize("dtype", [np.uint16, np.int16, np.float32])
def test_a_narrow_range_is_stretched_linearly_and_the_same_for_all_pictures(dtype):
    levels = levels_of([(7000 + 1.5 * GREY).astype(dtype)])
    seen = levels.eight_bits((7000 + 1.5 * GREY).astype(dtype))
    assert np.ptp(seen.astype(int)) > 150
    assert np.corrcoef(seen.ravel(), GREY.ravel())[0, 1] > 0.999
    warmer = levels.eight_bits((7050 + 1.5 * GREY).astype(dtype))
    assert np.mean(warmer > seen) > 0.9


def test_a_hot_pixel_does_not_set_the_range():
    deep = (16 * GREY).astype(np.uint16)
    deep[5, 5] = 65535
    assert np.abs(levels_of([deep]).eight_bits(deep)[6:].astype(int) - GREY[6:]).max() == 0


@pytest.mark.parametrize("odd", [[0], [65535], [0] * 15, [8000], [65535, 0, 0]])
def test_pictures_of_a_closed_shutter_do_not_set_the_range(odd):
    thermal = (7000 + 1.5 * GREY).astype(np.uint16)
    shut = [np.full(GREY.shape, value, np.uint16) for value in odd]
    assert levels_of(iter([*shut, *[thermal] * 12])) == levels_of([thermal] * 10)


def test_eight_bits_stay_and_colour_is_one_range():
    assert np.array_equal(Levels(10.0, 20.0, "").eight_bits(GREY.astype(np.uint8)), GREY)
    colour = np.stack([16 * GREY, 8 * GREY, 0 * GREY], axis=2).astype(np.uint16)
    assert np.array_equal(levels_of([colour]).eight_bits(colour), np.stack([GREY, GREY // 2, 0 * GREY], axis=2))


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
@pytest.mark.parametrize("brightest", [1.0, 0.5])
def test_floating_point_in_0_to_1_keeps_its_contrast(dtype, brightest):
    picture = (brightest * GREY / 255).astype(dtype)
    seen = levels_of([picture]).eight_bits(picture).astype(float)
    assert np.abs(seen - brightest * GREY).max() <= 1.0


def test_noise_of_a_first_picture_beyond_the_others_does_not_set_the_range():
    thermal = (7000 + 1.5 * GREY).astype(np.uint16)
    assert levels_of([(GREY / 20).astype(np.uint16), *[thermal] * 4]) == levels_of([thermal] * 4)


@pytest.mark.parametrize("picture", [np.zeros((4, 4), np.uint16), np.full((4, 4), np.nan, np.float32)])
def test_pictures_without_contrast_say_nothing(picture):
    levels = levels_of([picture])
    assert (levels.black, levels.white) == (0.0, 65536.0)
    assert not levels.eight_bits(picture).any()
