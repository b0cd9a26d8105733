"""Hamming matching: one-to-one, within its limits, guided or not."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edgeslam_torch.frontend.keypoint_grid import KeypointGrid
from edgeslam_torch.frontend.matching import best_pairs, hamming, match_all, words


def random_words(rng, n):
    return words(rng.integers(0, 256, (n, 32), dtype=np.uint8))


def flipped(rng, bits, count):
    """The same descriptors with ``count`` random bits flipped in each."""
    raw = np.unpackbits(bits.view(np.uint8), axis=1)
    for row in raw:
        row[rng.permutation(256)[:count]] ^= 1
    return words(np.packbits(raw, axis=1))


def test_hamming_is_opencvs(rng):
    a, b = rng.integers(0, 256, (2, 30, 32), dtype=np.uint8)
    expected = [int(cv2.norm(x, y, cv2.NORM_HAMMING)) for x, y in zip(a, b, strict=True)]
    assert hamming(words(a), words(b)).tolist() == expected


def test_shuffled_noisy_descriptors_find_their_partners(rng):
    a = random_words(rng, 300)
    order = rng.permutation(300)
    matches = match_all(a, flipped(rng, a, 20)[order], 64, 0.85)
    assert len(matches) == 300
    np.testing.assert_array_equal(order[matches.train], matches.query)
    np.testing.assert_array_equal(matches.distance, 20)


def test_ambiguous_matches_are_rejected_by_the_ratio(rng):
    a = random_words(rng, 10)
    twins = np.concatenate([a, a])
    assert len(match_all(flipped(rng, a, 5), twins, 64, 0.85)) == 0


@pytest.mark.parametrize(("n", "m"), [(0, 5), (5, 0), (5, 1), (0, 0)])
def test_nothing_to_match(rng, n, m):
    assert len(match_all(random_words(rng, n), random_words(rng, m), 64, 0.85)) == 0


candidates = st.lists(st.tuples(st.integers(0, 8), st.integers(0, 8), st.integers(0, 90)), max_size=60)


@given(candidates)
def test_best_pairs_are_one_to_one_within_limits_and_nearest(rows):
    unique = {(q, t): d for q, t, d in rows}
    q, t = (np.array([k[i] for k in unique], np.int64) for i in (0, 1))
    d = np.array(list(unique.values()), np.int64)
    matches = best_pairs(q, t, d, 64, 0.8)
    assert len(set(matches.query.tolist())) == len(matches)
    assert len(set(matches.train.tolist())) == len(matches)
    for query, train, distance in zip(matches.query, matches.train, matches.distance, strict=True):
        mine = sorted(d[q == query].tolist())
        assert distance == mine[0] == unique[(query, train)] <= 64
        assert len(mine) == 1 or distance <= 0.8 * mine[1]


def test_guided_search_distinguishes_similar_keypoints_by_position(rng):
    """Repeated texture: brute force refuses all, the predicted pixel decides."""
    a = np.repeat(random_words(rng, 5), 4, axis=0)
    uv = np.stack(np.meshgrid(np.arange(5) * 50.0, np.arange(4) * 50.0, indexing="ij"), axis=-1).reshape(-1, 2)
    b = flipped(rng, a, 5)
    assert len(match_all(a, b, 64, 0.5)) == 0
    query, train = KeypointGrid(uv).near(uv + 3.0, np.full(20, 15.0))
    guided = best_pairs(query, train, hamming(a[query], b[train]), 64, 0.5)
    np.testing.assert_array_equal(guided.query, guided.train)
    assert len(guided) == 20


def test_whole_images_match_both_ways_or_not_at_all():
    """The second is nearest to both; the first has no other, but is not what the second is nearest to."""
    bits = [[0] * 4, [3, 0, 0, 0], [1, 0, 0, 0], [2**64 - 1] * 4]
    a, b = np.array([bits[1], bits[0]], np.uint64), np.array([bits[0], bits[3]], np.uint64)
    assert dict(zip(match_all(a, b, 64, 0.8).query, match_all(a, b, 64, 0.8).train, strict=True)) == {1: 0}
