"""The same numbers in the files of many programs are the same camera; what is not understood is refused or said."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from edgeslam_torch.errors import CalibrationError
from edgeslam_torch.geometry.camera import PRESETS
from edgeslam_torch.geometry.camera_file import load_camera, read_camera, save_camera

SIZE = (752, 480)
FX, FY, CX, CY = 458.654, 457.296, 367.215, 248.375
D = [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
K = f"{FX}, 0., {CX}, 0., {FY}, {CY}, 0., 0., 1."
LIST = ", ".join(map(str, D))
LINE = " ".join(map(str, D))
OWN = f"width: 752\nheight: 480\nfx: {FX}\nfy: {FY}\ncx: {CX}\ncy: {CY}\n"
K_KEYS = ("k1", "k2", "p1", "p2")
ONE_A_LINE = "".join(f"{key}: {value}\n" for key, value in zip(K_KEYS, D, strict=True))
KALIBR = (
    f"  cam_overlaps: []\n  camera_model: pinhole\n  distortion_coeffs: [{LIST}]\n  distortion_model: radtan\n"
    f"  intrinsics: [{FX}, {FY}, {CX}, {CY}]\n  resolution: [752, 480]\n  rostopic: /cam0/image_raw\n"
)
ORB_SLAM = "%YAML:1.0\n\n# comment\n" + "".join(
    f"Camera.{key}: {value}\n"
    for key, value in zip(("fx", "fy", "cx", "cy", *K_KEYS, "k3"), (FX, FY, CX, CY, *D, 0.0), strict=True)
)
ORB_SLAM_REST = "Camera.fps: 20.0\nCamera.RGB: 1\nCamera.bf: 47.9\nThDepth: 35\nORBextractor.nFeatures: 1000\n"
OPENCV = (
    "%YAML:1.0\n---\nimage_width: 752\nimage_height: 480\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n"
    f"   dt: d\n   data: [ {K} ]\ndistortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 4\n   dt: d\n"
    f"   data: [ {LIST} ]\n"
)
XML = (
    '<?xml version="1.0"?>\n<opencv_storage>\n<image_width>752</image_width><image_height>480</image_height>\n'
    '<Camera_Matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>\n  <data>\n    '
    f"{K.replace(',', '')}</data></Camera_Matrix>\n"
    '<Distortion_Coefficients type_id="opencv-matrix"><rows>4</rows><cols>1</cols><dt>d</dt>'
    f"<data>{LINE}</data></Distortion_Coefficients>\n</opencv_storage>\n"
)
INFO = (
    'header:\n  seq: 81\n  stamp: {secs: 15, nsecs: 20}\n  frame_id: "cam0"\nheight: 480\nwidth: 752\n'
    f'distortion_model: "plumb_bob"\nD: [{LIST}, 0.0]\nK: [{K}]\nR: [1., 0., 0., 0., 1., 0., 0., 0., 1.]\n'
    f"P: [{K}, 0., 0., 0.]\nbinning_x: 0\nbinning_y: 0\nroi: {{x_offset: 0, y_offset: 0, height: 0, width: 0, "
    "do_rectify: false}\n"
)
OST = (
    f"image_width: 752\nimage_height: 480\ncamera_name: cam\ncamera_matrix: {{rows: 3, cols: 3, data: [{K}]}}\n"
    f"distortion_model: plumb_bob\ndistortion_coefficients: {{rows: 1, cols: 4, data: [{LIST}]}}\n"
    "rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}\n"
)
VINS = (
    "%YAML:1.0\n---\nmodel_type: PINHOLE\ncamera_name: camera\nimage_width: 752\nimage_height: 480\n"
    "distortion_parameters:\n"
    + "".join("   " + line + "\n" for line in ONE_A_LINE.splitlines())
    + "projection_parameters:\n"
    f"   fx: {FX}\n   fy: {FY}\n   cx: {CX}\n   cy: {CY}\nextrinsicRotation: !!opencv-matrix\n   rows: 1\n"
    "   cols: 1\n   dt: d\n   data: [0]\nacc_n: 0.08\nmin_dist: 30\nfisheye: 0\n"
)
COLMAP = f"# list\n1 OPENCV 752 480 {FX} {FY} {CX + 0.5} {CY + 0.5} {LINE}\n"
NERF = {"w": 752, "h": 480, "fl_x": FX, "fl_y": FY, "cx": CX + 0.5, "cy": CY + 0.5}
NERF |= {"camera_model": "OPENCV", "camera_angle_x": 1.37, "aabb_scale": 16, "applied_transform": [[1, 0, 0, 0]]}
NERF |= dict(zip(K_KEYS, D, strict=True)) | {"k3": 0, "k4": 0, "frames": [{"file_path": "images/a.png"}]}
FORMATS = {
    "ours": OWN + f"model: pinhole\ndistortion: [{LIST}]\nfocal_sigma: 0.0\ndepth_scale: 1000\n",
    "k1 keys": OWN + ONE_A_LINE,
    "in braces": "{" + (OWN + ONE_A_LINE).strip().replace("\n", ", ") + "}",
    "k1 keys, no dot": OWN + ONE_A_LINE.replace("1.76187114e-05", "176187114e-13"),
    "upper-case keys": OWN.upper() + ONE_A_LINE.upper(),
    **{name: OWN + f"{name}: [{LIST}]\n" for name in ("dist_coeffs", "D", "distortion_coefficients", "distCoeffs")},
    "list as text": OWN + f'distortion: "[{LIST}]"\n',
    "words as text": OWN + f"distortion: {LINE}\n",
    "column": OWN + "distortion:\n" + "".join(f"- [{k}]\n" for k in D),
    "matrix": f"width: 752\nheight: 480\nK: [[{FX}, 0, {CX}], [0, {FY}, {CY}], [0, 0, 1]]\nD: [[{LIST}]]\n",
    "no size": "\n".join(OWN.splitlines()[2:]) + f"\ndistortion: [{LIST}]\n",
    "camchain": "cam0:\n" + KALIBR,
    "two cameras": "cam0:\n" + KALIBR + "cam1:\n" + KALIBR.replace("458", "500"),
    "kalibr, flat": KALIBR.replace("  ", ""),
    "sensor.yaml": "#Default\nsensor_type: camera\ncomment: cam0\nT_BS:\n  cols: 4\n  rows: 4\n  data: [1]\n"
    "rate_hz: 20\n"
    + KALIBR.replace("  ", "").replace("radtan", "radial-tangential").replace("_coeffs", "_coefficients"),
    "orb-slam 2": ORB_SLAM + ORB_SLAM_REST,
    "orb-slam 2, opencv's dialect": ORB_SLAM.replace(": ", ":", 3) + "\tCamera.fps: 20\n".replace("\t", ""),
    "orb-slam 3": ORB_SLAM.replace("Camera.", "Camera1.")
    + 'Camera.type: "PinHole"\nCamera.width: 752\nCamera.height: 480\nCamera.newWidth: 600\nCamera2.fx: 1.0\n',
    "opencv": OPENCV,
    "xml": XML,
    "camera_info": INFO,
    "camera_info, ros 2": INFO.replace("D:", "d:").replace("K:", "k:").replace("R:", "r:").replace("P:", "p:")
    + "---\n",
    "ost": OST,
    "vins": VINS,
    "colmap": COLMAP,
    "colmap, two": COLMAP + "2 PINHOLE 640 480 500 500 320 240\n",
    "colmap, rational": COLMAP.replace("OPENCV", "FULL_OPENCV").rstrip() + " 0 0 0 0\n",
    "dso": f"RadTan {FX} {FY} {CX} {CY} {LINE}\n752 480\ncrop\n640 480\n",
    "dso, relative": f"{FX / 752} {FY / 480} {(CX + 0.5) / 752} {(CY + 0.5) / 480} {LINE}\n752 480\nnone\n752 480\n",
    "dpvo": f"{FX} {FY} {CX} {CY} {LINE}",
    "mast3r-slam": f"width: 752\nheight: 480\ncalibration: [{FX}, {FY}, {CX}, {CY}, {LIST}, 0.0]\n",
    "nerfstudio": json.dumps(NERF),
    "json": json.dumps({"mtx": [[FX, 0, CX], [0, FY, CY], [0, 0, 1]], "dist": [D], "width": 752, "height": 480}),
    "stella": "Camera:\n  model: perspective\n  setup: monocular\n  cols: 752\n  rows: 480\n  color_order: RGB\n"
    + "".join(f"  {line}\n" for line in (OWN.split("\n", 2)[2] + ONE_A_LINE).splitlines()),
    "utf-16": (OWN + ONE_A_LINE).encode("utf-16"),
    "byte order mark, latin-1": b"\xef\xbb\xbf# Stra\xdfe\r\n" + (OWN + ONE_A_LINE).replace("\n", "\r\n").encode(),
}


def _read(folder, content, name="c.yaml", size=SIZE):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_camera(path, size)


def test_our_own_file_round_trips(tmp_path):
    camera = replace(PRESETS["tum_fr1"], focal_sigma=0.12)
    save_camera(tmp_path / "camera.yaml", camera)
    back = load_camera(tmp_path / "camera.yaml")
    assert replace(back, source=camera.source) == camera


@pytest.mark.parametrize("name", FORMATS)
def test_the_same_numbers_are_the_same_camera(tmp_path, name):
    camera, remarks = _read(tmp_path, FORMATS[name])
    assert (camera.width, camera.height) == SIZE
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((FX, FY, CX, CY), abs=1e-9)
    assert camera.distortion == pytest.approx((*D, 0.0), abs=1e-12)
    of_size = camera.focal_sigma == 0 and all("size" in r or "cam" in r.lower() for r in remarks)
    assert of_size, remarks


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (FORMATS["two cameras"], "cam0"),
        (FORMATS["colmap, two"], "number 1"),
        (FORMATS["orb-slam 3"], "Camera2"),
        (FORMATS["dpvo"], "size"),
        (OWN + "exposure: 3\n", "exposure"),
        *((OWN + f"distortion_model: {lens}\n", "no distortion") for lens in ("radtan", "rational_polynomial")),
    ],
)
def test_choices_assumptions_and_gaps_are_reported(tmp_path, content, word):
    assert any(word in remark for remark in _read(tmp_path, content)[1])


FISHEYE = [0.02, -0.01, 0.003, 0.001]
NARROW = OWN.replace(str(FX), "900.0").replace(str(FY), "900.0")
FISHEYES = {
    "name": NARROW + f"camera_model: OPENCV_FISHEYE\ndistortion: {FISHEYE}\n",
    "kalibr": NARROW + f"camera_model: pinhole\ndistortion_model: equi\ndistortion_coeffs: {FISHEYE}\n",
    "any key": NARROW + f"sort: fisheye\ndistortion: {FISHEYE}\n",
    "switch": NARROW + f"fisheye_model: 1\ndistortion: {FISHEYE}\n",
    "orb-slam 3": f'%YAML:1.0\nCamera.type: "KannalaBrandt8"\nCamera1.fx: 900.0\nCamera1.fy: 900.0\nCamera1.cx: {CX}\n'
    f"Camera1.cy: {CY}\n" + "".join(f"Camera1.k{i + 1}: {k}\n" for i, k in enumerate(FISHEYE)),
    "vins": "model_type: KANNALA_BRANDT\nimage_width: 752\nimage_height: 480\nprojection_parameters:\n"
    + "".join(f"   k{i + 2}: {k}\n" for i, k in enumerate(FISHEYE))
    + f"   mu: 900.0\n   mv: 900.0\n   u0: {CX}\n   v0: {CY}\n",
    "colmap": f"1 OPENCV_FISHEYE 752 480 900 900 {CX + 0.5} {CY + 0.5} {' '.join(map(str, FISHEYE))}\n",
    "dso": f"KannalaBrandt 900 900 {CX} {CY} {' '.join(map(str, FISHEYE))}\n752 480\nfull\n752 480\n",
}


@pytest.mark.parametrize("name", FISHEYES)
def test_a_narrow_fisheye_is_fitted_and_its_error_reported(tmp_path, name):
    camera, remarks = _read(tmp_path, FISHEYES[name])
    p = np.array([[0.3, 0.2, 1.0], [-0.35, 0.1, 1.0], [0.0, -0.25, 1.0]])
    truth, _ = cv2.fisheye.projectPoints(p[:, None], np.zeros(3), np.zeros(3), camera.K, np.array(FISHEYE))
    assert np.abs(camera.project_through_lens(p) - truth.reshape(-1, 2)).max() < 0.3
    assert any("px off" in remark for remark in remarks)


WIDE = OWN.replace("458.654", "200.0").replace("457.296", "200.0")
LAUGHS = "<!DOCTYPE l [<!ENTITY a 'ha'>]>"


@pytest.mark.parametrize(
    "text",
    [
        OWN + f"distorsion: [{LIST}]\n",
        OWN + f"camera_model: OPENCV_FISHEYE\ndistortion: [{LIST}, 0.0]\n",
        WIDE + f"camera_model: OPENCV_FISHEYE\ndistortion: [{LIST}]\n",
        OWN + "distortion_model: fisheye\n",
        OWN + "lens_kind: double_sphere\n",
        OWN + "k2: 0.1\n",
        OWN + "xi: 0.9\n",
        OWN + "skew: 3.0\n",
        OWN + "fov: 60\n",
        OWN + "k1: [0.1, 0.2]\n",
        OWN + "k1: .nan\n",
        OWN + "k1: 0.2\ndistortion: [0.1, 0.1, 0, 0]\n",
        OWN + "distortion: [0.1, 0.2, 0.3]\n",
        OWN + "distortion: {rows: 1, cols: 5, data: [0.1, 0.1, 0, 0]}\n",
        OWN + "distortion_model: none\ndistortion: [0.1, 0.1, 0, 0]\n",
        OWN + "distortion_model: radtan\ncamera_model: fisheye\n",
        OWN + "focal: 460\n",
        OWN + "focal_sigma: high\n",
        OWN + "focal_sigma: -0.1\n",
        OWN + "distortion: [1.0e+300, 0, 0, 0, 0]\n",
        OWN + "a: &a [x]\ndistortion_model: *a\n",
        OWN.replace(f"fx: {FX}", "fx: 3.6"),
        OWN.replace(f"fx: {FX}", "fx: .nan"),
        OWN.replace(f"fy: {FY}\n", ""),
        "",
        OWN + "binning_x: 2\n",
        OWN.replace("752", "752.5"),
        OWN.replace("752", "-752"),
        OWN.replace(f"fx: {FX}", "fx: '458,654'"),
        ORB_SLAM + f"LEFT.K: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [{K.replace('458', '400')}]\n",
        XML.replace("<opencv_storage>", LAUGHS + "<opencv_storage>"),
        COLMAP.replace(LINE, "0.1"),
        json.dumps(NERF | {"frames": [{"fl_x": 1}, {"fl_x": 2}]}),
        json.dumps(NERF | {"camera_model": "EQUIRECTANGULAR"}),
        "1 2 3 4 5 6 7 8 9 10\n",
        f"0.6 0.9 0.5 0.5 {LINE}\n",
        b"\x00\x01\x02" * 99,
        "[" * 2_000,
        OWN + "# " + "x" * 300_000,
    ],
)
def test_unsupported_content_is_rejected_in_one_line(tmp_path, text):
    with pytest.raises(CalibrationError) as raised:
        _read(tmp_path, text)
    assert "\n" not in str(raised.value)
    assert len(str(raised.value)) < 500 + len(str(tmp_path))


def test_a_file_without_a_size_needs_images(tmp_path):
    with pytest.raises(CalibrationError, match="width and height"):
        _read(tmp_path, FORMATS["dpvo"], size=None)


def test_an_angle_of_the_fov_model_is_fitted(tmp_path):
    camera, remarks = _read(tmp_path, "1.2 1.875 0.5 0.5 0.5\n752 480\ncrop\n640 480\n")
    r = np.arctan(2 * 0.3 * np.tan(0.25)) / 0.5
    uv = camera.project_through_lens(np.array([[0.3, 0.0, 1.0]]))
    assert uv[0] == pytest.approx((375.5 + 1.2 * 752 * r, 239.5), abs=0.3)
    assert any("px off" in remark for remark in remarks)
