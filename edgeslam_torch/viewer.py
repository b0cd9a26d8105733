"""Live view in rerun (https://rerun.io, the ``[viewer]`` extra): image, edges, depth, map, trajectory, scale.

Nothing else imports this module, and it imports rerun only when a viewer is made.
"""

import importlib
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch.errors import ConfigError
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.types import FloatArray, PointCloud, SlamOutput

_STATUS_COLOURS = {
    "initialised": (127, 180, 216),
    "tracked": (47, 127, 184),
    "relocalised": (122, 92, 192),
    "predicted": (217, 145, 43),
    "lost": (200, 64, 47),
}


class Viewer:
    """One rerun recording, shown in its window, saved to a file, or both.

    Args:
        name: Title of the recording.
        save: ``.rrd`` file to write.
        show: Start the viewer's window.

    Raises:
        ConfigError: If rerun is not installed.
    """

    def __init__(self, name: str, save: Path | None = None, show: bool = True) -> None:
        try:
            self._rr: Any = importlib.import_module("rerun")
        except ImportError as error:
            raise ConfigError("the viewer needs rerun: pip install 'edgeslam-torch[viewer]'") from error
        rr = self._rr
        rr.init(f"edgeslam {name}", spawn=show and save is None)
        if save is not None:
            save.parent.mkdir(parents=True, exist_ok=True)
            rr.save(str(save))
        rr.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._path: list[FloatArray] = []

    def camera(self, camera: Camera) -> None:
        """Intrinsics of the picture under ``world/camera``."""
        rr = self._rr
        rr.log(
            "world/camera/image",
            rr.Pinhole(image_from_camera=camera.K, resolution=[camera.width, camera.height], image_plane_distance=0.2),
            static=True,
        )

    def step(
        self,
        output: SlamOutput,
        image: np.ndarray | None = None,
        features_uv: FloatArray | None = None,
        edges_uv: FloatArray | None = None,
        depth_m: FloatArray | None = None,
    ) -> None:
        """Show one frame: pose, status, and whatever of the pictures is at hand.

        Args:
            output: What `EdgeSlam.step` returned.
            image: BGR ``(H, W, 3)`` or grey ``(H, W)``, undistorted.
            features_uv: Keypoints ``(N, 2)`` [px].
            edges_uv: Edge pixels ``(E, 2)`` [px].
            depth_m: Network depth ``(H, W)`` [m].
        """
        rr = self._rr
        rr.set_time("time", duration=output.stamp_s)
        self._pose(output.T_w_c)
        self._path.append(output.T_w_c[:3, 3].copy())
        colour = _STATUS_COLOURS[str(output.status)]
        rr.log("world/trajectory", rr.LineStrips3D([np.array(self._path)], colors=[colour]))
        if image is not None:
            rgb = image if image.ndim == 2 else image[:, :, ::-1]
            rr.log("world/camera/image", rr.Image(np.ascontiguousarray(rgb)).compress(jpeg_quality=75))
        if features_uv is not None:
            rr.log("world/camera/image/features", rr.Points2D(features_uv, colors=[(90, 200, 120)], radii=1.5))
        if edges_uv is not None:
            rr.log("world/camera/image/edges", rr.Points2D(edges_uv, colors=[(240, 150, 40)], radii=0.6))
        if depth_m is not None:
            rr.log("world/camera/depth", rr.DepthImage(depth_m, meter=1.0))
        rr.log("status", rr.TextLog(f"{output.index}: {output.status} {output.reason}".strip()))
        rr.log("plots/inliers", rr.Scalars(output.inliers))
        rr.log("plots/step_ms", rr.Scalars(sum(output.stage_ms.values())))
        if np.isfinite(output.scale.sigma):
            rr.log("plots/scale", rr.Scalars(output.scale.value))
            rr.log("plots/scale_sigma", rr.Scalars(output.scale.sigma))

    def map(self, cloud: PointCloud, entity: str = "edges") -> None:
        """Show the map as it is now."""
        self._rr.log(f"world/{entity}", self._rr.Points3D(cloud.p_w, colors=cloud.colour))

    def show_run(
        self, stamps_s: FloatArray, T_w_c: FloatArray, edges: PointCloud | None, anchors: PointCloud | None
    ) -> None:
        """Show a finished run: poses over time and the final map."""
        rr = self._rr
        for name, cloud in (("edges", edges), ("anchors", anchors)):
            if cloud is not None:
                rr.log(f"world/{name}", rr.Points3D(cloud.p_w, colors=cloud.colour), static=True)
        rr.log("world/trajectory", rr.LineStrips3D([T_w_c[:, :3, 3]], colors=[(47, 127, 184)]), static=True)
        for stamp, T in zip(stamps_s, T_w_c, strict=True):
            rr.set_time("time", duration=float(stamp - stamps_s[0]))
            self._pose(T)

    def close(self) -> None:
        """Flush the recording."""
        self._rr.disconnect()

    def _pose(self, T_w_c: FloatArray) -> None:
        rr = self._rr
        rr.log("world/camera", rr.Transform3D(translation=T_w_c[:3, 3], mat3x3=T_w_c[:3, :3]))
