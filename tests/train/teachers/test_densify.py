"""Dense teacher from sparse map points and a network's depth."""

import numpy as np

from edgeslam_torch.train.teachers.densify import densify


def scene():
    """Log depth of a tilted wall, and a network's view of it: 30 % too far on the left, right on the right."""
    true = np.log(np.linspace(1.5, 3.0, 160, dtype=np.float32))[None].repeat(120, 0)
    wrong = true + np.linspace(0.3, 0.0, 160, dtype=np.float32)[None]
    return true, wrong


def test_points_correct_the_network_smoothly(rng):
    true, wrong = scene()
    uv = np.stack([rng.uniform(0, 159, 600), rng.uniform(0, 119, 600)], 1)
    log_z = true[np.rint(uv[:, 1]).astype(int), np.rint(uv[:, 0]).astype(int)]
    out = densify(wrong, uv, log_z)
    assert np.abs(out - true).mean() < 0.2 * np.abs(wrong - true).mean()
    assert np.abs(np.diff(out - wrong, axis=1)).max() < 0.02, "no steps at the points"


def test_one_outlier_changes_little(rng):
    true, _ = scene()
    uv = np.stack([rng.uniform(0, 159, 300), rng.uniform(0, 119, 300)], 1)
    log_z = true[np.rint(uv[:, 1]).astype(int), np.rint(uv[:, 0]).astype(int)].copy()
    log_z[7] += 1.5
    assert np.abs(densify(true, uv, log_z) - true).max() < 0.02
