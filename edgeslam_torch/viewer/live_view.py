"""Shows a running system in rerun: `--viewer` and `--save-rrd`."""

from pathlib import Path
from typing import TYPE_CHECKING

from edgeslam_torch.config import EdgeConfig
from edgeslam_torch.frontend.edges import extract_edges
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.types import Frame, SlamOutput
from edgeslam_torch.viewer.rerun_viewer import Viewer

if TYPE_CHECKING:
    from edgeslam_torch.run import Slam

MAP_EVERY_KEYFRAMES = 3
"""Interval for sending the whole map; every keyframe would cost more than mapping."""

_SHOWN_EDGES = 20_000


class LiveView:
    """A listener of `edgeslam_torch.run.run`."""

    def __init__(self, name: str, camera: Camera, save: Path | None) -> None:
        """Open the viewer's window, or its file.

        Raises:
            ConfigError: If rerun is not installed.
        """
        self._viewer = Viewer(name, save=save, show=save is None)
        self._viewer.camera(camera)
        self._camera = camera
        self._edges = EdgeConfig()
        self._keyframes = 0

    def on_frame(self, frame: Frame, output: SlamOutput, slam: "Slam") -> None:
        """Show pose and picture; for keyframes also features, edges and depth, and periodically the map."""
        image = self._camera.undistort_image(frame.image)
        if not output.keyframe:
            self._viewer.step(output, image)
            return
        keyframe = slam.keyframes()[-1]
        depth = keyframe.depth  # read once: the mapping thread releases it after measuring edges
        edges = extract_edges(image, self._edges.canny_low, self._edges.canny_high, _SHOWN_EDGES)
        self._viewer.step(output, image, keyframe.features.uv, edges.uv, None if depth is None else depth.depth_m)
        self._keyframes += 1
        if self._keyframes % MAP_EVERY_KEYFRAMES == 1:
            self._viewer.map(slam.edge_map())

    def on_finish(self, slam: "Slam") -> None:
        """Show the refined map and close the recording."""
        self._viewer.map(slam.edge_map())
        self._viewer.map(slam.anchors(), "anchors")
        self._viewer.close()
