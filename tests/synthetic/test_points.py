"""The noise-free point world."""

import numpy as np

from edgeslam_torch import synthetic


def test_box_room_projects_exactly(rng: np.random.Generator) -> None:
    world = synthetic.box_room(rng, n_points=30)
    for T_c_w, uv in zip(world.T_c_w, world.uv, strict=True):
        p_c = world.p_w @ T_c_w[:3, :3].T + T_c_w[:3, 3]
        assert np.all(p_c[:, 2] > 0.5)
        np.testing.assert_allclose(p_c @ world.K.T / p_c[:, 2:], np.column_stack([uv, np.ones(30)]), atol=1e-9)
