"""A stub of the SLAM system with known results."""

import numpy as np

from edgeslam_torch.geometry import se3
from edgeslam_torch.types import FrameStatus, Observations, Piece, PointCloud, ScaleEstimate, SlamOutput, Support


class FakeSlam:
    """Moves 1 cm along x with every frame; black images have no pose; refined poses lie 1 m higher."""

    def __init__(self, camera=None, config=None, on_step=None):
        self.outputs = []
        self.telemetry = []
        self.finished = False
        self.events = {"lost": 0}
        self.scale = ScaleEstimate(1.0, 0.02, "depth")
        self.on_step = on_step

    def prepare(self, frame):
        return None

    def step(self, frame, telemetry=(), prepared=None):
        if self.on_step is not None:
            self.on_step(len(self.outputs))
        self.telemetry.append(list(telemetry))
        good = frame.image.max() > 0
        T = se3.exp(np.array([0.01 * frame.index, 0, 0, 0, 0, 0.01 * frame.index]))
        output = SlamOutput(
            index=frame.index,
            stamp_s=frame.stamp_s,
            T_w_c=T,
            status=FrameStatus.TRACKED if good else FrameStatus.PREDICTED,
            reason="" if good else "only 0 keypoints, image is black",
            matches=100,
            inliers=80,
            parallax_rad=0.01,
            keyframe=frame.index % 5 == 0,
            piece=0,
            scale=self.scale,
            metric=True,
            revision=0,
            stage_ms={"features": 1.0, **({"mapping": 5.0} if frame.index % 5 == 0 else {})},
        )
        self.outputs.append(output)
        return output

    def finish(self):
        self.finished = True

    def close(self):
        pass

    def trajectory(self):
        poses = np.stack([o.T_w_c for o in self.outputs])
        poses[:, 2, 3] += 1.0
        return np.array([o.stamp_s for o in self.outputs]), poses

    def losses(self):
        return {}

    def telemetry_statistics(self):
        return {}

    def support(self):
        return Support(np.zeros(len(self.outputs), int), np.array([o.status.supported for o in self.outputs]))

    def pieces(self):
        supported = sum(o.status.supported for o in self.outputs)
        stamps = [o.stamp_s for o in self.outputs]
        return [Piece(0, len(stamps), supported, stamps[0], stamps[-1], "first frame")]

    def joins(self):
        return []

    def closures(self):
        return []

    def warnings(self):
        return []

    def edge_map(self):
        p = np.random.default_rng(0).random((500, 3)).astype(np.float32)
        return PointCloud(p, (p * 255).astype(np.uint8), np.full(500, 0.01, np.float32), np.full(500, 3, np.int32))

    def anchors(self):
        return self.edge_map()

    def observations(self):
        none = np.zeros(0, np.int64)
        return Observations(np.zeros(0), none, none, np.zeros((0, 2), np.float32))

    def keyframes(self):
        return [o for o in self.outputs if o.keyframe]
