"""Processing of a new keyframe: image, depth, anchors, refinement, edges.

Synchronous, or on the single thread of an executor while the next frames are tracked.
"""

from concurrent.futures import Executor, Future
from dataclasses import dataclass

from edgeslam_torch.estimation.displacement import TelemetryModel
from edgeslam_torch.frontend.depth_check import CheckedDepth
from edgeslam_torch.frontend.image import as_grey, colours_at
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.map.depth_prior import sample
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.mapping.edges.edge_map import EdgeMap
from edgeslam_torch.mapping.mapper import Mapper
from edgeslam_torch.stage_times import timed
from edgeslam_torch.types import FloatArray, Frame


@dataclass(frozen=True, slots=True)
class Mapped:
    """Result of mapping a batch of keyframes."""

    keyframes: list[Keyframe]
    T_tracked: FloatArray
    """``T_c_w`` of the newest before refinement ``(4, 4)``."""
    stage_ms: dict[str, float]


class MappingPipeline:
    """Maps keyframes, one batch at a time.

    Args:
        mapper: Anchors and refinement.
        edges: Edge map.
        camera: Intrinsics of the frames.
        depth: Depth network; None for none.
        executor: With one thread, for real time; None for synchronous mapping.
    """

    def __init__(
        self,
        mapper: Mapper,
        edges: EdgeMap,
        camera: Camera,
        depth: CheckedDepth | None,
        executor: Executor | None,
    ) -> None:
        self.mapper = mapper
        self.edges = edges
        self.camera = camera
        self.depth = depth
        self.has_metres = False
        """Whether the depth network has provided metric depth yet."""
        self._executor = executor
        self._pending: Future[Mapped] | None = None

    @property
    def busy(self) -> bool:
        """Whether keyframes are being mapped, or are mapped and not yet collected."""
        return self._pending is not None

    def submit(self, new: list[tuple[Frame, Keyframe]], telemetry: TelemetryModel | None = None) -> Mapped | None:
        """Map keyframes that are already in the map; None if this runs asynchronously."""
        if self._executor is None:
            return self._run(new, telemetry)
        self._pending = self._executor.submit(self._run, new, telemetry)
        return None

    def collect(self, wait: bool = False) -> Mapped | None:
        """Result of the last submission once it is complete; None before, or without one."""
        if self._pending is None or not (wait or self._pending.done()):
            return None
        pending, self._pending = self._pending, None
        return pending.result()

    def close(self) -> None:
        """Stop the executor."""
        if self._executor is not None:
            self._executor.shutdown(wait=True, cancel_futures=True)

    def look(self, frame: Frame, keyframe: Keyframe) -> None:
        """Set a keyframe's undistorted image and depth."""
        keyframe.image = self.camera.undistort_image(frame.image)
        keyframe.grey = as_grey(keyframe.image)
        keyframe.depth = None if self.depth is None else self.depth(keyframe.image, self.camera)
        if keyframe.depth is not None and not keyframe.depth.is_relative:
            keyframe.network_m = sample(keyframe.depth, keyframe.features.uv)[0]
            self.has_metres = True

    def _run(self, new: list[tuple[Frame, Keyframe]], telemetry: TelemetryModel | None) -> Mapped:
        """Map a batch; the only function that runs on the executor."""
        stage_ms: dict[str, float] = {}
        T_tracked = new[-1][1].T_c_w
        for frame, keyframe in new:
            with timed(stage_ms, "depth"):
                self.look(frame, keyframe)
            assert keyframe.image is not None
            with timed(stage_ms, "mapping"):
                self.mapper.insert(keyframe, colours_at(keyframe.image, keyframe.features.uv), telemetry)
            with timed(stage_ms, "edges"):
                self.edges.announce(keyframe)
                self.edges.update()
        return Mapped([k for _, k in new], T_tracked, stage_ms)
