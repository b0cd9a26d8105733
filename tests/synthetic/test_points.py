"""The noise-free point world."""

import numpy as np

from edgeslam_torch import synthetic


def test_box_room_projects_exactly(rng: np.random.Generator) -> None:
    world = synthetic.box_room(rng, n_points=30)
    for T_c_w, uv in zip(world.T_c_w, world.uv, strict=True):
        p_c = world.p_w @ T_c_w[:3, :3].T + T_c_w[:3, 3]
        assert np.all(p_c[:, 2] > 0.5)
        np.testing.assert_allclose(p_c @ world.K.T / p_c[:, 2:], np.column_stack([uv, np.ones(30)]), atol=1e-9)


def test_box_room_has_baseline_depth_range_and_views(rng: np.random.Generator) -> None:
    world = synthetic.box_room(rng, n_points=200, n_views=4)
    assert world.visible.shape == (4, 200)
    assert world.visible.mean() > 0.3
    assert world.visible.sum(0).max() >= 3
    centres = -np.einsum("wji,wj->wi", world.T_c_w[:, :3, :3], world.T_c_w[:, :3, 3])
    gaps = np.linalg.norm(centres[:, None] - centres[None], axis=-1)[np.triu_indices(4, 1)]
    assert gaps.min() > 0.5
    assert np.ptp(world.p_w[:, 0]) > 2.0


def test_box_room_follows_dtype_and_seed() -> None:
    a, b = (synthetic.box_room(np.random.default_rng(4), 10, np.float32) for _ in range(2))
    assert a.uv.dtype == a.p_w.dtype == a.T_c_w.dtype == a.K.dtype == np.float32
    assert a.uv.tobytes() == b.uv.tobytes()
