"""Poses of frames hang on keyframes."""

import numpy as np
from point_map import filled, small_motion

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.rotations import vectors_from_matrices
from edgeslam_torch.map.trajectory import TrajectoryLog


def forward(x):
    """Pose of a camera that went ``x`` along its own x axis."""
    T = np.eye(4)
    T[0, 3] = -x
    return T


def test_frames_follow_their_keyframe_even_after_its_removal(rng):
    """Refinement moves the heir of a removed keyframe by M: the frames tied to either follow rigidly."""
    points = filled(rng, 200, 3)
    log = TrajectoryLog(points.map)
    poses = [small_motion(rng, 0.5, 0.2) for _ in range(4)]
    for i, T_c_w in enumerate(poses):
        log.append(i, 0.1 * i, min(i, 2), T_c_w, True)
    np.testing.assert_allclose(log.poses()[1], se3.inverse(np.stack(poses)), atol=1e-12)
    points.map.remove_keyframe(points.keyframes[1])
    np.testing.assert_allclose(log.poses()[1], se3.inverse(np.stack(poses)), atol=1e-12)
    M = small_motion(rng, 0.1, 0.1)
    heir = points.map.keyframes[points.map.links[1][0]]
    heir.T_c_w = heir.T_c_w @ M
    moved = log.poses()[1]
    np.testing.assert_allclose(moved[1], se3.inverse(poses[1] @ M), atol=1e-12)
    np.testing.assert_allclose(
        moved[0 if heir.id == 2 else 2], se3.inverse(poses[0 if heir.id == 2 else 2]), atol=1e-12
    )


def test_replaced_poses_are_those_of_the_newest_frames_only(rng):
    points = filled(rng, 200, 3)
    log = TrajectoryLog(points.map)
    assert log.poses()[1].shape == (0, 4, 4)
    old, new = [small_motion(rng, 0.5, 0.2) for _ in range(4)], small_motion(rng, 0.5, 0.2)
    for i, T_c_w in enumerate(old):
        log.append(i, 0.1 * i, 0, T_c_w, False)
    points.keyframes[1].frame_index = 3  # frame 2 comes before it and stays with the first
    log.replace({2: new, 3: old[0]}, points.keyframes[:2])
    stamps, T_w_c = log.poses()
    np.testing.assert_allclose(stamps, [0.0, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(se3.inverse(T_w_c), np.stack([old[0], old[1], new, old[0]]), atol=1e-12)
    assert [r.keyframe_id for r in log.records] == [0, 0, 0, 1]
    assert log.support().supported.tolist() == [False, False, True, True]


def test_frames_follow_the_next_keyframe_where_refinement_moved_it(rng):
    """Tracked twice as far as it was: halved between the keyframes, and no frame jumps."""
    points = filled(rng, 200, 2)
    a, b = points.keyframes
    a.T_c_w = np.eye(4)

    log = TrajectoryLog(points.map)
    log.append(0, 0.0, a.id, a.T_c_w, True, np.eye(4))
    for i, x in enumerate((0.2, 0.4, 0.6), 1):
        log.append(i, 0.1 * i, a.id, forward(x), True)
    before = log.relative_to_last(forward(0.8))
    b.T_c_w = forward(0.4)
    log.append(4, 0.4, b.id, b.T_c_w, True, before)
    log.append(5, 0.5, b.id, forward(0.5), True)
    np.testing.assert_allclose(log.poses()[1][:, 0, 3], [0.0, 0.1, 0.2, 0.3, 0.4, 0.5], atol=1e-12)
    log.records[2].supported = False  # a predicted frame between them, without a measured pose
    np.testing.assert_allclose(log.poses()[1][:, 0, 3], [0.0, 0.2, 0.4, 0.6, 0.4, 0.5], atol=1e-12)


def test_a_turn_of_the_next_keyframe_is_distributed_as_well(rng):
    points = filled(rng, 200, 2)
    a, b = points.keyframes
    a.T_c_w = np.eye(4)

    log = TrajectoryLog(points.map)
    for i, x in enumerate((0.0, 0.2, 0.4, 0.6)):
        log.append(i, 0.1 * i, a.id, forward(x), True, None if i else np.eye(4))
    before = log.relative_to_last(forward(0.8))
    b.T_c_w = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.2])) @ forward(0.8)
    log.append(4, 0.4, b.id, b.T_c_w, True, before)
    turned = vectors_from_matrices(se3.inverse(log.poses()[1])[:, :3, :3])
    np.testing.assert_allclose(turned, np.outer([0.0, 0.05, 0.1, 0.15, 0.2], [0.0, 0.0, 1.0]), atol=1e-8)
    assert len(log.poses(count=2)[0]) == 2


def test_frames_of_the_first_map_are_corrected_too(rng):
    """It was never tracked as a frame; those after it are tied to it, those before it to the first keyframe."""
    points = filled(rng, 200, 3)
    first, second, third = points.keyframes

    first.T_c_w, second.T_c_w = forward(0.0), forward(0.4)
    log = TrajectoryLog(points.map)
    for i, (keyframe, x) in enumerate(((first, 0.0), (first, 0.2), (second, 0.4), (second, 0.8), (second, 1.2))):
        log.append(i, 0.1 * i, keyframe.id, forward(x), True)
    before = log.relative_to_last(forward(1.6))
    third.T_c_w = forward(0.7)
    log.append(5, 0.5, third.id, third.T_c_w, True, before)
    np.testing.assert_allclose(log.poses()[1][:, 0, 3], [0.0, 0.2, 0.4, 0.5, 0.6, 0.7], atol=1e-12)
