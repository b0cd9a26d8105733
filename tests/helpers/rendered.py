"""Short rendered flights with known poses and depth, made once per test session."""

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np

from edgeslam_torch.eval.inputs.trajectory_files import Trajectory, write_tum
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.camera_file import save_camera
from edgeslam_torch.synthetic.house.render import render
from edgeslam_torch.synthetic.house.views import random_pose
from edgeslam_torch.synthetic.house.world import Quad, Texture, World
from edgeslam_torch.synthetic.sites.build import place
from edgeslam_torch.types import DepthMap, Frame

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5, source="test")


@dataclass(frozen=True)
class RenderedFlight:
    """Frames with their truth."""

    camera: Camera
    frames: list[Frame]
    depth_m: list[np.ndarray]
    T_w_c: np.ndarray
    """``(F, 4, 4)``"""
    world: World

    @property
    def stamps_s(self):
        return np.array([f.stamp_s for f in self.frames])

    def depth_function(self):
        """The exact depth of a known image, as a depth network would give it."""
        known = {f.image.tobytes(): d for f, d in zip(self.frames, self.depth_m, strict=True)}

        def depth(image, camera):
            d = known[image.tobytes()]
            return DepthMap(d, np.full(d.shape, 0.05, np.float32))

        return depth

    def first(self, count):
        """The flight up to its ``count``-th image."""
        frames, depth_m, T_w_c = self.frames[:count], self.depth_m[:count], self.T_w_c[:count]
        return replace(self, frames=frames, depth_m=depth_m, T_w_c=T_w_c)

    def write(self, folder, depth_every=0):
        """A recording in TUM's layout with camera and ground truth; every so many images a depth map [mm]."""
        for name in ("rgb", "depth"):
            (folder / name).mkdir(parents=True)
        lists = {"rgb": "", "depth": ""}
        for frame, z in zip(self.frames, self.depth_m, strict=True):
            images = {"rgb": frame.image}
            if depth_every and frame.index % depth_every == 0:
                images["depth"] = (1000 * z).astype(np.uint16)
            for kind, image in images.items():
                cv2.imwrite(str(folder / kind / f"{frame.stamp_s:.3f}.png"), image)
                lists[kind] += f"{frame.stamp_s:.3f} {kind}/{frame.stamp_s:.3f}.png\n"
        (folder / "rgb.txt").write_text(lists["rgb"])
        if depth_every:
            (folder / "depth.txt").write_text(lists["depth"])
        save_camera(folder / "camera.yaml", self.camera)
        with (folder / "camera.yaml").open("a") as file:
            file.write("depth_scale: 1000.0\n")
        write_tum(Trajectory(self.stamps_s, self.T_w_c), folder / "groundtruth.txt")
        return folder

    def with_images(self, change):
        """Frames whose images are what ``change(index, image)`` makes of them."""
        return [Frame(f.index, f.stamp_s, change(f.index, f.image)) for f in self.frames]


@lru_cache(maxsize=1)
def panels():
    """40 images past panels at many depths: 1.2 m sideways, turning by 9 degrees."""
    return film(stairs_world(), CAMERA, sideways(40, 0.03, turn_rad=0.004), step_s=1 / 30)


@lru_cache(maxsize=1)
def room_view():
    """A furnished room, ``(240, 320, 3)``."""
    rng = np.random.default_rng(3)
    world = place("furnished_room", rng)
    return render(world, CAMERA, random_pose(rng, world)).image


@lru_cache(maxsize=1)
def views():
    """Three images of `stairs_world`, 30 cm apart."""
    return [f.image for f in film(stairs_world(), CAMERA, sideways(3, 0.3)).frames]


def film(world, camera, T_w_c, step_s=0.1):
    """Render every pose."""
    views = [render(world, camera, T) for T in T_w_c]
    frames = [Frame(i, 100.0 + step_s * i, v.image) for i, v in enumerate(views)]
    return RenderedFlight(camera, frames, [v.depth_m for v in views], np.asarray(T_w_c), world)


def patchwork(rng, side_px=768, patches=1500):
    """Texture ``(side, side, 3)`` of random rectangles: corners everywhere, no two alike."""
    image = np.full((side_px, side_px, 3), 128, np.uint8)
    for _ in range(patches):
        x, y = rng.integers(0, side_px, 2)
        w, h = rng.integers(6, side_px // 10, 2)
        image[y : y + h, x : x + w] = rng.integers(20, 235, 3)
    return image


def wall(rng, distance_m=2.0, half_m=3.0, side_px=768):
    """A patchwork wall across the camera's axis, for cameras near the origin that look along world z."""
    texture = Texture(patchwork(rng, side_px))
    u, v = np.array([2.0 * half_m, 0.0, 0.0]), np.array([0.0, 2.0 * half_m, 0.0])
    return Quad(np.array([-half_m, -half_m, distance_m]), u, v, texture)


@lru_cache(maxsize=2)
def stairs_world(seed=8):
    """Patchwork panels at several depths before a wall: parallax everywhere, nothing planar."""
    rng = np.random.default_rng(seed)
    quads = [wall(rng, 4.0, 4.0, 1024)]
    for i in range(5):
        for j in range(4):
            z = rng.uniform(1.6, 3.4)
            x, y = (i - 2.0) * 0.62 * z / 2.4, (j - 1.5) * 0.6 * z / 2.4
            size = 0.28 * z / 2.4
            texture = Texture(patchwork(rng, 160, 90))
            u, v = np.array([2 * size, 0.0, 0.4 * size]), np.array([0.0, 2 * size, 0.0])
            quads.append(Quad(np.array([x - size, y - size, z]), u, v, texture))
    return World(quads)


def sideways(count, step_m, *, turn_rad=0.0, forward_m=0.0):
    """``(F, 4, 4)`` ``T_w_c``: along camera x with a bow along y, turning about y, looking along world z."""
    poses = []
    for i in range(count):
        T = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, turn_rad * i, 0.0]))
        T[:3, 3] = [step_m * (i - (count - 1) / 2), 0.3 * step_m * np.sin(0.5 * i), forward_m * i]
        poses.append(T)
    return np.stack(poses)
