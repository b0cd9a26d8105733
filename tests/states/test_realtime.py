"""Mapping on another thread while frames are tracked, with a scheduler that the test controls."""

import threading
from concurrent.futures import Executor, Future
from dataclasses import replace

import numpy as np
import pytest
from point_map import check_map
from rendered import CAMERA, film, panels, sideways, stairs_world

from edgeslam_torch.config import DepthConfig, SlamConfig
from edgeslam_torch.eval.metrics.align import umeyama
from edgeslam_torch.geometry import se3
from edgeslam_torch.slam import EdgeSlam
from edgeslam_torch.states.machine import State
from edgeslam_torch.types import FrameStatus


class Job(Future):
    """Work that was handed over; asking for its result before it is done does it."""

    def __init__(self, work):
        super().__init__()
        self._work = work

    def run(self):
        try:
            self.set_result(self._work())
        except BaseException as error:
            self.set_exception(error)

    def result(self, timeout=None):
        if not self.done():
            self.run()
        return super().result(timeout)


class Scheduler(Executor):
    """Keeps what is submitted until `work`; with ``at_once`` it is done when it is submitted."""

    def __init__(self, at_once=False):
        self.at_once, self.jobs, self.is_shut = at_once, [], False

    def submit(self, fn, /, *args, **kwargs):
        assert not self.is_shut
        self.jobs.append(Job(lambda: fn(*args, **kwargs)))
        if self.at_once:
            self.work()
        return self.jobs[-1]

    @property
    def waiting(self):
        return [job for job in self.jobs if not job.done()]

    def work(self):
        for job in self.waiting:
            job.run()

    def shutdown(self, wait=True, *, cancel_futures=False):
        self.is_shut = True


NO_NETWORK = SlamConfig(depth=DepthConfig(weights="none"))
SUPPORTED = {FrameStatus.INITIALISED, FrameStatus.TRACKED}


def realtime(scheduler, depth=None):
    return EdgeSlam(CAMERA, NO_NETWORK, depth=depth, realtime=True, executor=scheduler)


def to_the_map(slam, scheduler):
    """Steps until there is a map; returns the remaining frames."""
    frames = iter(panels().frames)
    for frame in frames:
        if slam.step(frame).status is FrameStatus.INITIALISED:
            assert len(scheduler.jobs) == 1
            return frames
    raise AssertionError("the map never stands")


def ate(T_w_c, truth):
    aligned = umeyama(T_w_c[:, :3, 3], truth[:, :3, 3]).points(T_w_c[:, :3, 3])
    return float(np.sqrt(np.mean(np.sum((aligned - truth[:, :3, 3]) ** 2, axis=1))))


def move_the_map(slam, M):
    """A refinement that moves the whole map rigidly by ``p' = M p``."""
    anchors, R = slam.map.anchors, M[:3, :3]
    anchors.p_w[:] = se3.transform(M, anchors.p_w)
    anchors.origin[:] = se3.transform(M, anchors.origin)
    anchors.normal[:] = anchors.normal @ R.T
    for keyframe in slam.map.keyframes.values():
        keyframe.T_c_w = keyframe.T_c_w @ se3.inverse(M)


def test_a_worker_that_finishes_at_once_gives_the_same_map_as_none():
    scheduler = Scheduler(at_once=True)
    slam = realtime(scheduler)
    outputs = [slam.step(frame) for frame in panels().frames]
    slam.finish()
    check_map(slam.map)
    assert ate(slam.trajectory()[1], panels().T_w_c) < 0.012
    assert slam.support().supported.all()
    assert set(slam.events.values()) == {0}
    assert "keyframes_skipped" in slam.events
    assert sum(o.keyframe for o in outputs) == len(scheduler.jobs) + 1  # the first one starts alone
    assert len(slam.edge_map().p_w) > 3000


def test_refinement_of_the_newest_keyframe_corrects_the_camera_pose():
    """The map moves by 60 cm and 20 degrees while frames are tracked against its old state."""
    M = se3.exp(np.array([0.4, -0.3, 0.3, 0.1, 0.3, -0.15]))
    scheduler = Scheduler()
    slam = realtime(scheduler)
    frames = to_the_map(slam, scheduler)
    before = [slam.step(next(frames)) for _ in range(3)]
    scheduler.work()
    move_the_map(slam, M)
    after = [slam.step(next(frames)) for _ in range(3)]
    assert {o.status for o in after} == {FrameStatus.TRACKED}
    assert slam.events["lost"] == slam.events["relocalised"] == 0
    # Motion between consecutive cameras as in truth up to the map's scale, also across the correction.
    first = before[0].index
    truth = se3.inverse(panels().T_w_c[first]) @ panels().T_w_c[first + 5]
    found = se3.inverse(M @ before[0].T_w_c) @ after[-1].T_w_c
    assert np.linalg.norm(se3.log(found)[3:] - se3.log(truth)[3:]) < np.deg2rad(0.5)
    cosine = found[:3, 3] @ truth[:3, 3] / np.linalg.norm(found[:3, 3]) / np.linalg.norm(truth[:3, 3])
    assert cosine > np.cos(np.deg2rad(5.0))


def test_a_frame_waits_for_the_worker_once_a_keyframe_was_due():
    scheduler = Scheduler()
    slam = realtime(scheduler)
    frames = to_the_map(slam, scheduler)
    busy = []
    while slam.events["keyframes_skipped"] == 0:
        busy.append(slam.step(next(frames)))
        assert len(scheduler.waiting) == 1, "tracking continues meanwhile"
    assert {o.status for o in busy} == {FrameStatus.TRACKED}
    assert not any(o.keyframe for o in busy)
    after = [slam.step(next(frames)) for _ in range(8)]
    assert scheduler.jobs[0].done() and any(o.keyframe for o in after)
    assert slam.state is State.TRACKING
    slam.finish()
    check_map(slam.map)
    assert ate(slam.trajectory()[1], panels().T_w_c[: len(slam.trajectory()[1])]) < 0.02


def test_finish_waits_for_pending_mapping():
    scheduler = Scheduler()
    slam = realtime(scheduler)
    frames = to_the_map(slam, scheduler)
    for _ in range(4):
        slam.step(next(frames))
    assert scheduler.waiting
    slam.finish()
    assert not scheduler.waiting
    newest = slam.keyframes()[-1]
    assert newest in scheduler.jobs[-1].result().keyframes
    assert len(newest.keypoints_with_anchor()) > 100
    assert len(slam.edge_map().p_w) > 0, "edges of the last keyframe are measured at the end"
    slam.close()
    assert scheduler.is_shut


def test_an_error_in_mapping_is_raised_by_step():
    def depth(image, camera):
        if scheduler.jobs:
            raise RuntimeError("the network broke")

    scheduler = Scheduler()
    slam = realtime(scheduler, depth)
    frames = to_the_map(slam, scheduler)
    scheduler.work()
    with pytest.raises(RuntimeError, match="the network broke"):
        slam.step(next(frames))


def test_reading_and_tracking_continue_while_the_network_runs():
    """A real thread blocks inside the depth network until the others have finished."""
    inside, go_on = threading.Event(), threading.Event()

    def depth(image, camera):
        if threading.current_thread() is not threading.main_thread():
            inside.set()
            assert go_on.wait(60.0)

    scheduler = Scheduler()
    slam = realtime(scheduler, depth)
    frames = to_the_map(slam, scheduler)
    worker = threading.Thread(target=scheduler.work, daemon=True)
    worker.start()
    assert inside.wait(120.0)
    step = slam.step(next(frames))
    stamps, T_w_c = slam.trajectory()
    anchors, edges, keyframes = slam.anchors(), slam.edge_map(), slam.keyframes()
    assert scheduler.waiting, "the worker was busy all the time"
    go_on.set()
    worker.join(120.0)
    assert step.status is FrameStatus.TRACKED
    assert len(stamps) == len(T_w_c) == step.index + 1
    assert np.isfinite(T_w_c).all()
    assert len({len(x) for x in (anchors.p_w, anchors.colour, anchors.sigma_m, anchors.observations)}) == 1
    assert len(anchors.p_w) > 100
    assert len(edges.p_w) == 0
    assert [k.id for k in keyframes] == sorted(k.id for k in keyframes)


def dark(frame):
    """The same situation with blank images."""
    return replace(frame, image=np.zeros_like(frame.image))


def test_after_a_lost_frame_the_next_waits_for_the_worker():
    scheduler = Scheduler()
    slam = realtime(scheduler)
    frames = to_the_map(slam, scheduler)
    slam.step(next(frames))
    lost = [slam.step(dark(next(frames))) for _ in range(3)]
    assert {o.status for o in lost} == {FrameStatus.PREDICTED}
    assert slam.state is State.LOST
    assert not scheduler.waiting
    found = next(o for o in map(slam.step, frames) if o.status is not FrameStatus.PREDICTED)
    assert found.status is FrameStatus.RELOCALISED
    assert slam.state is State.TRACKING


def test_a_new_submap_begins_after_pending_mapping():
    """Lost beyond the time-out, then at another place: two threads never write to the map."""
    scheduler = Scheduler()
    slam = realtime(scheduler)
    frames = to_the_map(slam, scheduler)
    reached = slam.step(next(frames)).index
    elsewhere = film(stairs_world(seed=1), CAMERA, sideways(40, 0.03), step_s=1 / 30).frames
    for frame in elsewhere[reached + 1 :]:
        output = slam.step(frame)
        if slam.state is State.STARTING:
            break
        assert output.status is FrameStatus.PREDICTED
    assert frame.stamp_s - elsewhere[reached + 1].stamp_s == pytest.approx(0.65, abs=0.04)
    assert slam.events["restarted"] == 1
    assert output.keyframe
    assert not scheduler.waiting
