"""Edge pixels of a batch."""

import pytest
import torch

from edgeslam_torch.frontend.canny import canny_batch
from edgeslam_torch.train.views.edges import edge_pixels


def squares():
    images = torch.full((3, 3, 40, 48), 0.2)
    images[0, :, 10:30, 12:36] = 0.9
    images[1, :, 5:9, 40:44] = 0.9
    return images


def test_pixels_lie_on_edges_and_each_is_drawn_once():
    images = squares()
    edges = canny_batch(images, 50, 120)
    uv = edge_pixels(images, 60)
    assert uv.shape == (3, 60, 2)
    for b, (found, mask) in enumerate(zip(uv, edges, strict=True)):
        known = found[~found.isnan().any(-1)].long()
        assert len(known) == min(60, int(mask.sum())), b
        assert mask[known[:, 1], known[:, 0]].all()
        assert len({tuple(row) for row in known.tolist()}) == len(known)
    assert uv[2].isnan().all()


def test_draws_follow_the_generator_and_reach_all_edges():
    images = squares()[:1]
    draws = [edge_pixels(images, 30, generator=torch.Generator().manual_seed(seed)) for seed in (1, 1, 2)]
    assert torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])
    whole = edge_pixels(images, 40 * 48 + 5)  # more than there are pixels
    assert int((~whole.isnan()).all(-1).sum()) == int(canny_batch(images, 50, 120).sum())


@pytest.mark.parametrize("images", [255 * torch.rand(1, 3, 8, 8), torch.full((1, 1, 8, 8), 200, dtype=torch.uint8)])
def test_grey_levels_are_refused_with_what_to_do(images):
    with pytest.raises(ValueError, match="divide grey levels by 255"):
        edge_pixels(images, 4)


def test_image_without_a_batch_is_refused():
    with pytest.raises(ValueError, match=r"\(3, 40, 48\)"):
        edge_pixels(squares()[0], 5)
