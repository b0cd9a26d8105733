"""Folders with depth: paired, undistorted, holes kept, unreadable files named."""

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from edgeslam_torch.errors import SourceError
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.models.checkpoint import build_network, load_checkpoint, save_checkpoint
from edgeslam_torch.models.fastdepth import Widths
from edgeslam_torch.models.record import Metadata
from edgeslam_torch.train.datasets import has_depth, load_depth_folder, read_list

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)


def write_folder(folder: Path, count: int = 12, camera: Camera = CAMERA) -> Path:
    rng = np.random.default_rng(0)
    (folder / "rgb").mkdir(parents=True)
    (folder / "depth").mkdir()
    lines: dict[str, list[str]] = {"rgb": ["# comment"], "depth": []}
    depth = np.tile(np.linspace(1000, 3000, 64).astype(np.uint16), (48, 1))
    depth[:10] = 0
    depth[10:12] = 65535
    for k in range(count):
        t = 100 + k / 30
        cv2.imwrite(str(folder / "rgb" / f"{k}.png"), rng.integers(0, 256, (48, 64, 3), np.uint8))
        cv2.imwrite(str(folder / "depth" / f"{k}.png"), depth)
        lines["rgb"].append(f"{t:.6f} rgb/{k}.png")
        lines["depth"].append(f"{t + 0.004:.6f} depth/{k}.png")
    for name, rows in lines.items():
        (folder / f"{name}.txt").write_text("\n".join(rows) + "\n")
    camera.save(folder / "camera.yaml")
    with (folder / "camera.yaml").open("a") as file:
        file.write("depth_scale: 1000.0\n")
    return folder


def test_depth_is_metres_and_holes_are_zero(tmp_path: Path) -> None:
    folder = load_depth_folder(write_folder(tmp_path / "a"))
    assert len(folder.views) == 12
    depth = folder.views[0].depth_m
    assert (depth[:12] == 0).all()
    np.testing.assert_allclose(depth[20], np.linspace(1, 3, 64), atol=1e-3)
    assert len(load_depth_folder(tmp_path / "a", stride=3, max_frames=9).views) == 3


def test_reduced_image_has_reduced_intrinsics(tmp_path: Path) -> None:
    view = load_depth_folder(write_folder(tmp_path / "a", 1), width=32).views[0]
    assert view.image.shape == (24, 32, 3)
    np.testing.assert_allclose(view.K, CAMERA.scaled(32, 24).K)


def test_distorted_lens_is_straightened_without_mixing_depths(tmp_path: Path) -> None:
    bent = replace(CAMERA, distortion=(0.3, 0.0, 0.0, 0.0, 0.0))
    depth = load_depth_folder(write_folder(tmp_path / "a", 1, bent)).views[0].depth_m
    levels = np.round(np.linspace(1000, 3000, 64)) / 1000
    assert np.abs(depth[depth > 0][:, None] - levels).min(1).max() < 2e-3


def test_unreadable_files_are_listed_and_the_rest_is_used(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "a")
    (folder / "rgb" / "3.png").write_bytes(b"broken")
    (folder / "depth" / "5.png").unlink()
    loaded = load_depth_folder(folder)
    assert len(loaded.views) == 10
    assert [Path(p).parent.name + "/" + Path(p).name for p in loaded.unreadable] == ["rgb/3.png", "depth/5.png"]


def test_missing_and_malformed_lists_are_named(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "a", 1)
    assert has_depth(folder)
    assert not has_depth(tmp_path)
    (folder / "depth.txt").write_text("not a list\n")
    with pytest.raises(SourceError, match=r"depth\.txt:1"):
        load_depth_folder(folder)
    with pytest.raises(SourceError, match="cannot read the list"):
        read_list(folder / "none.txt")


def test_finetune_on_labelled_images_reports_before_and_after(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from edgeslam_torch.commands import finetune

    metadata = Metadata(input_height=32, input_width=64, focal_px=60.0)
    torch.manual_seed(0)
    save_checkpoint(build_network(metadata, Widths((4,) + (8,) * 13, (8,) * 5)), metadata, tmp_path / "s.safetensors")
    folder = write_folder(tmp_path / "a")
    (folder / "rgb" / "3.png").write_bytes(b"broken")
    parser = argparse.ArgumentParser()
    finetune.add_arguments(parser)
    given = [str(folder), "--out", str(tmp_path / "out"), "--weights", str(tmp_path / "s.safetensors")]
    assert finetune.main(parser.parse_args([*given, "--steps", "60", "--batch", "2", "--lr", "0.01"])) == 0
    printed = capsys.readouterr().out
    assert "a: 11 images with depth" in printed
    assert "left out, unreadable" in printed
    rows = [line.split("|") for line in printed.splitlines() if line.startswith(("| before", "| after"))]
    assert float(rows[1][2]) < float(rows[0][2])
    assert "abs_rel" in load_checkpoint(tmp_path / "out" / "weights.safetensors")[1].metrics
    with pytest.raises(SourceError, match="no such recording"):
        finetune.main(parser.parse_args([str(tmp_path / "gone"), "--out", str(tmp_path / "o2")]))
