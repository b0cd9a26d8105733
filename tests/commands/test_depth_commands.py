"""Smoke runs of ``edgeslam depth``, ``export`` and ``weights`` on made-up images and small random weights."""

import argparse
import importlib
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from small_networks import FAR_M, NEAR_M, RELATIVE, describe, green_network

from edgeslam_torch.cli import main
from edgeslam_torch.errors import ConfigError, EdgeSlamError
from edgeslam_torch.files import download
from edgeslam_torch.frontend.depth_network import DepthPredictor
from edgeslam_torch.frontend.external_depth import ExternalDepth
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.camera_file import save_camera
from edgeslam_torch.models.checkpoint import build_network, load_checkpoint, save_checkpoint
from edgeslam_torch.models.fastdepth import FastDepth, Variant, Widths
from edgeslam_torch.models.onnx.graph import build_graph
from edgeslam_torch.models.record import Metadata
from edgeslam_torch.types import DepthMap

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
METADATA = Metadata(input_height=96, input_width=128, focal_px=105.0)
SMALL = Widths((8, 16) + (24,) * 12, (24, 24, 24, 16, 16))


def run(command, *args):
    module = importlib.import_module(f"edgeslam_torch.commands.{command}")
    parser = argparse.ArgumentParser()
    module.add_arguments(parser)
    return module.main(parser.parse_args([str(a) for a in args]))


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / "small.safetensors"
    save_checkpoint(build_network(METADATA, SMALL).eval(), METADATA, path)
    return path


@pytest.fixture
def pictures(tmp_path, rng):
    folder = tmp_path / "pictures"
    folder.mkdir()
    for k in range(10):
        small = rng.integers(0, 256, (9, 12, 3), np.uint8)
        cv2.imwrite(str(folder / f"img{k}.png"), cv2.resize(small, (160, 120), interpolation=cv2.INTER_CUBIC))
    save_camera(folder / "camera.yaml", CAMERA)
    return folder


def test_depth_of_a_folder(weights, pictures, tmp_path, capsys):
    out = tmp_path / "out"
    (pictures / "img0.png").write_bytes(b"\x89PNG")
    assert run("depth", pictures, "--out", out, "--weights", weights, "--sigma", "--max-frames", "3") == 0
    said = capsys.readouterr().out
    assert "3 depth maps" in said and "left out: " in said and "img0.png: " in said
    assert len(list(out.iterdir())) == 12
    metres = np.load(out / "img1.npy")
    expected = DepthPredictor(weights)(cv2.imread(str(pictures / "img1.png")), CAMERA)
    np.testing.assert_allclose(metres, expected.depth_m, rtol=1e-5)
    millimetres = cv2.imread(str(out / "img1.png"), cv2.IMREAD_UNCHANGED)
    assert millimetres.dtype == np.uint16
    np.testing.assert_allclose(millimetres, np.clip(metres * 1000, 0, 65535), atol=0.51)
    assert cv2.imread(str(out / "img1_colour.png")).shape == (150, 160, 3)  # the bar below has 30 rows


@pytest.mark.parametrize("few", [True, False])
def test_depth_maps_never_take_the_images_place_nor_join_pictures_of_others(weights, pictures, tmp_path, few):
    (pictures / "img0.png").rename(tmp_path / "one.png")
    for old in list(pictures.glob("*.png"))[2:] if few else []:  # so few are no recording
        old.unlink()
    before = {p.name: p.read_bytes() for p in pictures.iterdir()}
    with pytest.raises(EdgeSlamError, match="holds the images themselves" if few else "which no run wrote"):
        run("depth", pictures if few else tmp_path / "one.png", "--out", pictures, "--weights", weights)
    assert {p.name: p.read_bytes() for p in pictures.iterdir()} == before
    for picture in pictures.glob("*.png"):
        run("depth", picture, "--out", tmp_path / "out", "--weights", weights)


def test_depth_maps_that_cannot_be_meant_are_unknown_and_counted(weights, pictures, tmp_path, capsys, monkeypatch):
    def far(self, image, camera):
        return DepthMap(np.full(image.shape[:2], 1e30, np.float32), np.ones(image.shape[:2], np.float32))

    monkeypatch.setattr(DepthPredictor, "__call__", far)
    run("depth", pictures, "--out", tmp_path / "out", "--weights", weights, "--max-frames", "2")
    assert "2 of 2 depth maps are mostly unknown" in capsys.readouterr().out
    assert np.isnan(np.load(tmp_path / "out" / "img0.npy")).all()
    assert not cv2.imread(str(tmp_path / "out" / "img0.png"), cv2.IMREAD_UNCHANGED).any()


def test_depth_of_one_image_uses_the_camera_beside_it(weights, pictures, tmp_path):
    run("depth", pictures / "img2.png", "--out", tmp_path / "a", "--weights", weights)
    run("depth", pictures / "img2.png", "--out", tmp_path / "b", "--weights", weights, "--camera", "kinect")
    a, b = np.load(tmp_path / "a" / "img2.npy"), np.load(tmp_path / "b" / "img2.npy")
    np.testing.assert_allclose(b / a, 525.0 / 4 / 130.0, rtol=1e-3)


@pytest.mark.slow
def test_int8_export_is_checked_and_runs_on_the_companion_example(weights, pictures, tmp_path, capfd):
    out = tmp_path / "depth.onnx"
    options = ("--int8", "--calibrate", pictures, "--old-runtime", "--size", "64x96")
    assert run("export", "--depth", weights, "--out", out, *options) == 0
    printed, complaints = capfd.readouterr()
    assert "arning" not in complaints and "rror" not in complaints, "the status line alone"
    assert "| float32 |" in printed
    assert "| int8 |" in printed
    model = onnx.load(str(out))
    assert model.ir_version <= 9
    assert [o.version for o in model.opset_import if o.domain == ""] == [17]
    kinds = {n.op_type for n in model.graph.node}
    assert {"QuantizeLinear", "DequantizeLinear"} <= kinds
    assert onnxruntime.InferenceSession(str(out)).get_inputs()[0].shape == [1, 3, 64, 96]
    example = Path(__file__).parents[2] / "examples" / "depth_companion.py"
    picture = pictures / "img0.png"
    command = [sys.executable, str(example), str(out), "--source", str(picture), "--fx", "130", "--fy", "130"]
    printed = subprocess.run(command, check=True, capture_output=True, text=True, timeout=120).stdout
    z = DepthPredictor(out)(cv2.imread(str(picture)), CAMERA).depth_m
    assert float(printed.split()[2]) == pytest.approx(float(z[58:63, 78:83].mean()), rel=0.05)


@pytest.mark.parametrize(
    "words", ["--int8", "--int8 --calibrate {pictures}", "--size 100x100", "--size big", "--size 99999968x32",
              "--opset -1", "--opset 3", "--opset 99"],
)  # fmt: skip
def test_export_refuses_what_makes_no_sense(weights, pictures, tmp_path, words):
    for k in range(5):  # too few are left
        (pictures / f"img{k}.png").unlink()
    with pytest.raises(ConfigError):
        run("export", weights, "--out", tmp_path / "x.onnx", *words.format(pictures=pictures).split())
    assert not (tmp_path / "x.onnx").exists()


@pytest.mark.slow
def test_weights_list_inspect_convert(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("EDGESLAM_CACHE", str(tmp_path / "cache"))
    run("weights", "list")
    listed = capsys.readouterr().out
    assert "mobilenet-nnconv5dw-skipadd-pruned: pruned" in listed
    assert "near: mobilenet-nnconv5dw-skipadd\n" in listed
    run("weights", "inspect", "near")
    assert "hololens_a" in capsys.readouterr().out
    run("weights", "inspect")
    printed = capsys.readouterr().out
    assert "3.96 M parameters" in printed
    assert "licence: Apache-2.0" in printed
    torch.save(FastDepth(Variant.PRUNED).state_dict(), tmp_path / "plain.pth.tar")
    run("weights", "convert", tmp_path / "plain.pth.tar", "--out", tmp_path / "c.safetensors")
    assert "skipadd-pruned" in capsys.readouterr().out
    with pytest.raises(ConfigError, match="there are"):
        run("weights", "download", "resnet")


def test_download_says_how_far_a_file_can_be_trusted(tmp_path, capsys, monkeypatch):
    """First, again, changed: with a file in the server's place."""

    def fetch(url, part, max_bytes, progress):
        part.write_bytes(content)

    torch.save(FastDepth(Variant.PRUNED).state_dict(), tmp_path / "plain.pth")
    content = (tmp_path / "plain.pth").read_bytes()
    monkeypatch.setenv("EDGESLAM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(download, "fetch", fetch)
    name = "mobilenet-nnconv5dw-skipadd-pruned"
    run("weights", "download", name)
    assert "trusted on first use" in capsys.readouterr().out
    run("weights", "download", name)
    assert "the same as at the first download" in capsys.readouterr().out
    content += b"\0"
    with pytest.raises(EdgeSlamError, match="has changed since"):
        run("weights", "download", name)


def test_a_description_of_a_network_replaces_no_file_of_others(tmp_path, monkeypatch):
    monkeypatch.setenv("EDGESLAM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(download, "fetch", lambda *given: pytest.fail("fetched"))
    (tmp_path / "settings.toml").write_text("precious")
    out = tmp_path / "settings.onnx"
    assert main(["weights", "download", "depth-anything-v2-small", "--out", str(out)]) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["settings.toml"]


def test_two_images_of_one_name_are_two_depth_maps(weights, pictures, tmp_path):
    for old in pictures.glob("*.png"):
        if old.name != "img0.png":
            old.unlink()
    cv2.imwrite(str(pictures / "img0.jpg"), cv2.imread(str(pictures / "img0.png"))[::-1])
    run("depth", pictures, "--out", tmp_path / "out", "--weights", weights)
    maps = sorted((tmp_path / "out").glob("*.npy"))
    assert len(maps) == 2
    assert not np.array_equal(np.load(maps[0]), np.load(maps[1]))


def test_a_download_that_is_no_network_is_not_remembered(tmp_path, monkeypatch):
    monkeypatch.setenv("EDGESLAM_CACHE", str(tmp_path))
    monkeypatch.setattr(download, "fetch", lambda url, part, *_: part.write_bytes(b"<html>not found</html>"))
    with pytest.raises(EdgeSlamError, match="checkpoint"):
        run("weights", "download", "mobilenet-nnconv5")
    assert not list(tmp_path.glob("*.sha256"))


def test_inspect_reads_exported_files_and_shows_no_control_characters(weights, tmp_path, capsys):
    network, metadata = load_checkpoint(weights)
    loud = replace(metadata, notes="red \x1b[31m\nlicence: free", input_height=2048, input_width=2048, focal_px=1000.0)
    save_checkpoint(network, loud, tmp_path / "loud.safetensors")
    run("weights", "inspect", tmp_path / "loud.safetensors")
    assert "notes: red \\x1b[31m\\nlicence: free" in capsys.readouterr().out
    (tmp_path / "w.onnx").write_bytes(build_graph(weights)[0])
    run("weights", "inspect", tmp_path / "w.onnx")
    assert "focal_px: 105.0" in capsys.readouterr().out


def test_depth_maps_of_a_relative_network_would_have_no_unit(pictures, tmp_path):
    network = describe(green_network(tmp_path / "n.onnx", **RELATIVE), 'preset = "midas-small"\n')
    with pytest.raises(ConfigError, match="up to scale and shift"):
        run("depth", pictures, "--out", tmp_path / "out", "--weights", network)


def test_numbers_that_are_not_as_described_are_said(pictures, tmp_path, capsys, monkeypatch):
    def reference(image, camera):
        depth_m = NEAR_M + (FAR_M - NEAR_M) * image[:, :, 1] / np.float32(255.0)
        return DepthMap(depth_m, np.full_like(depth_m, 0.1))

    monkeypatch.setattr(ExternalDepth, "reference", staticmethod(reference))
    logarithm = [onnx.helper.make_node("Log", ["depth"], ["log"])]
    network = describe(green_network(tmp_path / "n.onnx", logarithm, "log"), 'gives = "metres"\n')
    assert run("depth", pictures, "--out", tmp_path / "out", "--weights", network) == 0
    assert "gives = 'log_metres'" in capsys.readouterr().out


def test_network_of_others_is_inspected_by_its_description(tmp_path, capsys):
    network = describe(green_network(tmp_path / "n.onnx"), 'preset = "metric3d-v2-small"\ndepth = ""\n')
    assert run("weights", "inspect", network) == 0
    said = capsys.readouterr().out
    assert "gives: metres" in said and "focal_px: 1000.0" in said


def test_a_missing_device_is_said_before_anything_is_written(weights, pictures, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    out = tmp_path / "out"
    for words in (("depth", pictures, "--weights", weights), ("run", pictures, "--depth", weights)):
        with pytest.raises(ConfigError, match="--device cuda: .*; use --device cpu"):
            run(words[0], *words[1:], "--out", out, "--device", "cuda")
        assert not out.exists() or not list(out.glob("*.npy")) + list(out.glob("trajectory.txt"))
