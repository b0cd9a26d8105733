"""Live view in rerun (https://rerun.io, the ``[viewer]`` extra): image, edges, depth, map, trajectory, scale.

rerun is imported only when a viewer is created.
"""

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch.errors import OutputError
from edgeslam_torch.extras import needs_extra
from edgeslam_torch.files.plain import create
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.types import FloatArray, PointCloud, SlamOutput

_STATUS_COLOURS = {
    "starting": (201, 168, 106),
    "initialised": (127, 180, 216),
    "tracked": (47, 127, 184),
    "relocalised": (122, 92, 192),
    "predicted": (217, 145, 43),
    "lost": (200, 64, 47),
}

_SEGMENT = 100
"""Poses per trajectory segment: only the last segment is sent again with a new pose."""


class Viewer:
    """One rerun recording, shown in its window or saved to a file.

    Args:
        name: Title of the recording.
        save: ``.rrd`` file to write.
        show: Start the viewer's window; not together with ``save``.
        live: Lay the window out for `step` (pictures and plots beside the map); else for `show_run`.

    Raises:
        MissingPackageError: If rerun is not installed.
        OutputError: If ``save`` cannot be written.
    """

    def __init__(self, name: str, save: Path | None = None, show: bool = True, live: bool = True) -> None:
        self._rr, self._stream = open_recording(f"edgeslam {name}", save, show, lambda rrb: _layout(rrb, live))
        self._begin_s: float | None = None
        self._piece: list[FloatArray] = []
        self._piece_status = ""
        self._pieces = 0

    def camera(self, camera: Camera) -> None:
        """Intrinsics of the picture under ``world/camera``."""
        pinhole = self._rr.Pinhole(
            image_from_camera=camera.K, resolution=[camera.width, camera.height], image_plane_distance=0.2
        )
        self._log("world/camera/image", pinhole, static=True)

    def step(
        self,
        output: SlamOutput,
        image: np.ndarray | None = None,
        features_uv: FloatArray | None = None,
        edges_uv: FloatArray | None = None,
        depth_m: FloatArray | None = None,
    ) -> None:
        """Show one frame: pose, status, and the available pictures.

        Args:
            output: What `EdgeSlam.step` returned.
            image: BGR ``(H, W, 3)`` or grey ``(H, W)``, undistorted.
            features_uv: Keypoints ``(N, 2)`` [px].
            edges_uv: Edge pixels ``(E, 2)`` [px].
            depth_m: Network depth ``(H, W)`` [m].
        """
        rr = self._rr
        self._time(output.stamp_s)
        self._pose(output.T_w_c)
        self._extend(output.T_w_c[:3, 3], str(output.status))
        if image is not None:
            rgb = image if image.ndim == 2 else image[:, :, ::-1]
            self._log("world/camera/image", rr.Image(np.ascontiguousarray(rgb)).compress(jpeg_quality=75))
        if features_uv is not None:
            self._log("world/camera/image/features", rr.Points2D(features_uv, colors=[(90, 200, 120)], radii=1.5))
        if edges_uv is not None:
            self._log("world/camera/image/edges", rr.Points2D(edges_uv, colors=[(240, 150, 40)], radii=0.6))
        if depth_m is not None:
            millimetres = np.clip(1e3 * depth_m[::2, ::2], 0, 65535).astype(np.uint16)  # an eighth of the bytes
            self._log("depth", rr.DepthImage(millimetres, meter=1000.0))
        self._log("status", rr.TextLog(f"{output.index}: {output.status} {output.reason}".strip()))
        self._log("plots/inliers", rr.Scalars(output.inliers))
        self._log("plots/step_ms", rr.Scalars(sum(output.stage_ms.values())))
        if np.isfinite(output.scale.sigma):
            self._log("scale/value", rr.Scalars(output.scale.value))
            self._log("scale/sigma", rr.Scalars(output.scale.sigma))

    def map(self, cloud: PointCloud, entity: str = "edges") -> None:
        """Show the current map."""
        self._log(f"world/{entity}", self._rr.Points3D(cloud.p_w, colors=cloud.colour))

    def show_run(
        self, stamps_s: FloatArray, T_w_c: FloatArray, edges: PointCloud | None, anchors: PointCloud | None
    ) -> None:
        """Show a finished run: poses ``(F, 4, 4)`` over time and the final map."""
        rr = self._rr
        for name, cloud in (("edges", edges), ("anchors", anchors)):
            if cloud is not None:
                self._log(f"world/{name}", rr.Points3D(cloud.p_w, colors=cloud.colour), static=True)
        colour = _STATUS_COLOURS["tracked"]
        self._log("world/trajectory", rr.LineStrips3D([T_w_c[:, :3, 3]], colors=[colour]), static=True)
        for stamp, T in zip(stamps_s, T_w_c, strict=True):
            self._time(float(stamp))
            self._pose(T)

    def close(self) -> None:
        """Flush and end the recording."""
        self._stream.flush()
        self._stream.disconnect()

    def _log(self, entity: str, what: object, static: bool = False) -> None:
        self._stream.log(entity, what, static=static)

    def _time(self, stamp_s: float) -> None:
        """Set the viewer's clock: seconds since the first frame (Unix time is unreadable)."""
        if self._begin_s is None:
            self._begin_s = stamp_s
        self._stream.set_time("time", duration=stamp_s - self._begin_s)

    def _pose(self, T_w_c: FloatArray) -> None:
        self._log("world/camera", self._rr.Transform3D(translation=T_w_c[:3, 3], mat3x3=T_w_c[:3, :3]))

    def _extend(self, position: FloatArray, status: str) -> None:
        """Add a position to the trajectory, in the colour of its status."""
        if status != self._piece_status or len(self._piece) > _SEGMENT:
            self._piece = self._piece[-1:]  # joined to the previous segment
            self._piece_status = status
            self._pieces += 1
        self._piece.append(np.array(position))
        strip = self._rr.LineStrips3D([np.array(self._piece)], colors=[_STATUS_COLOURS[status]])
        self._log(f"world/trajectory/{self._pieces:04d}", strip)


def _layout(rrb: Any, live: bool) -> Any:
    """Layout of the window."""
    scene = rrb.Spatial3DView(origin="world", name="map and trajectory")
    if not live:
        return rrb.Blueprint(scene, collapse_panels=True)
    pictures = rrb.Vertical(
        rrb.Spatial2DView(origin="world/camera/image", name="camera, features, edges"),
        rrb.Spatial2DView(origin="depth", name="depth network"),
    )
    plots = rrb.Vertical(
        rrb.TimeSeriesView(origin="plots", name="inliers, milliseconds a frame"),
        rrb.TimeSeriesView(origin="scale", name="scale and its sigma"),
        rrb.TextLogView(origin="status", name="status"),
    )
    return rrb.Blueprint(rrb.Horizontal(scene, pictures, plots, column_shares=[4, 3, 3]), collapse_panels=True)


def open_recording(name: str, save: Path | None, show: bool, layout: Callable[[Any], Any]) -> tuple[Any, Any]:
    """rerun, and a recording with z up that is written to a file or shown in the viewer's window.

    Args:
        name: Title.
        save: ``.rrd`` file to write.
        show: Start the window, without a file.
        layout: Makes the window's layout from ``rerun.blueprint``.

    Raises:
        MissingPackageError: If rerun is not installed.
        OutputError: If ``save`` cannot be written; rerun itself would report it late, on a thread.
    """
    with needs_extra("viewer", "the viewer"):
        rr: Any = importlib.import_module("rerun")
        made = layout(importlib.import_module("rerun.blueprint"))
    stream: Any = rr.RecordingStream(name)
    if save is not None:
        try:
            save.parent.mkdir(parents=True, exist_ok=True)
            create(save).close()  # rerun itself would follow a link
        except OSError as error:
            raise OutputError(f"{save}: cannot be written ({error.strerror or error})") from error
        stream.save(str(save), default_blueprint=made)
    elif show:
        stream.spawn(default_blueprint=made)
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    return rr, stream
