"""Parse the text of a calibration file of any program to a record of keys and values for `calibrations.keys`.

YAML, JSON and OpenCV's XML are records. Lines of numbers are distinguished by their shape: COLMAP's ``cameras.txt``,
DSO's ``camera.txt``, DPVO's line, a matrix.
"""

import json
import re
import xml.etree.ElementTree as ElementTree
from typing import Any

from edgeslam_torch.files.record_files import plain_yaml

MAX_BYTES = 256 << 10
"""Maximum size of a file; those of OpenCV with all corners of the board take 200 kB, and PyYAML 2 s for it."""
MAX_JSON_BYTES = 16 << 20
"""Maximum size of a JSON file: transforms.json lists every image."""

COLMAP_MODELS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "FOV": "fx fy cx cy omega",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
    "THIN_PRISM_FISHEYE": "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1",
}
"""https://colmap.github.io/cameras.html; pixel centres at halves."""

_DSO_MODELS = ("pinhole", "fov", "atan", "radtan", "equidistant", "kannalabrandt")
"""First word of DSO's camera.txt, https://github.com/JakobEngel/dso#geometric-calibration-file."""
_FRAME_KEYS = frozenset(["fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "k4", "p1", "p2", "camera_model"])
CORNER_ORIGIN = "corner_origin"
"""Key for the convention that the first pixel's centre is (0.5, 0.5)."""


def record_of(data: bytes) -> tuple[dict[str, Any], list[str]]:
    """Keys and values of a calibration file, and remarks.

    Raises:
        ValueError: If the format is unknown.
        RecursionError: If it is nested too deeply.
    """
    text = _decoded(data).strip()
    if len(data) > MAX_BYTES and not text.startswith("{"):
        raise ValueError(f"{len(data) / 1e6:.1f} MB is too large")
    if text.startswith("<"):
        return _xml(text), []
    if text.startswith("{"):
        try:
            return _nerfstudio(json.loads(text)), []
        except json.JSONDecodeError:  # YAML may also begin with a brace
            if len(data) > MAX_BYTES:
                raise
    lines = [
        line.split() for line in text.replace(",", " ").split("\n") if line.strip() and line.strip()[0] not in "#%"
    ]
    if lines and len(lines[0]) > 3 and lines[0][1] in COLMAP_MODELS:
        return _colmap(lines)
    named = bool(lines) and re.sub("[^a-z]", "", lines[0][0].lower()) in _DSO_MODELS
    if lines and _all_numbers(lines[0][1:] if named else lines[0]) and len(lines[0]) > 2:
        return _numbers(lines, named), []
    if re.match(r"%YAML:", text):  # OpenCV's dialect: tabs, and no blank after a colon
        text = re.sub(r"(?m)^([ \t]*[A-Za-z_][\w.]*):(?=[-+\w.\"\[])", r"\1: ", text).expandtabs(4)
    record = plain_yaml(text)
    if not isinstance(record, dict):
        raise ValueError("no key: value lines in it")
    return record, []


def _decoded(data: bytes) -> str:
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return data.decode("utf-16")
    if b"\0" in data:
        raise ValueError("not text; export it as text")
    return data.decode("utf-8-sig", errors="replace")  # comments in other encodings


def _all_numbers(words: list[str]) -> bool:
    try:
        return [float(word) for word in words] != []
    except ValueError:
        return False


def _nerfstudio(record: dict[str, Any]) -> dict[str, Any]:
    """A JSON record; that of nerfstudio and instant-ngp (with COLMAP's pixel convention) may have intrinsics per frame.

    Raises:
        ValueError: If the intrinsics of the frames differ.
    """
    frames = record.get("frames")
    if not isinstance(frames, list):
        return record
    images = [{k: v for k, v in frame.items() if k in _FRAME_KEYS} for frame in frames if isinstance(frame, dict)]
    if any(image != images[0] for image in images):
        raise ValueError("its frames have different intrinsics; give those of one camera")
    return {CORNER_ORIGIN: True, **(images[0] if images else {}), **record}


def _xml(text: str) -> dict[str, Any]:
    """Record of OpenCV's FileStorage; entities, which can expand to gigabytes, are not supported."""
    if "<!" in re.sub(r"(?s)<!--.*?-->", "", text):
        raise ValueError("XML with declarations is not read")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(f"malformed XML, {error}") from error
    if root.tag != "opencv_storage":
        raise ValueError(f"XML of OpenCV's FileStorage is read, not {root.tag[:40]!r}")
    return {child.tag: _element(child) for child in root}


def _element(element: ElementTree.Element) -> Any:
    children = {child.tag: _element(child) for child in element}
    return children or (element.text or "").strip().strip('"')


def _colmap(lines: list[list[str]]) -> tuple[dict[str, Any], list[str]]:
    number, model, width, height, *values = lines[0]
    names = COLMAP_MODELS[model].split()
    if len(values) != len(names):
        raise ValueError(f"{model} takes {len(names)} numbers ({' '.join(names)}), got {len(values)}")
    record = {"width": width, "height": height, "model": model, CORNER_ORIGIN: True}
    others = {tuple(line[1:]) for line in lines[1:]} - {tuple(lines[0][1:])}
    remarks = [f"{len(lines)} cameras in it, number {number} is used"] if others else []
    return record | dict(zip(names, values, strict=True)), remarks


def _numbers(lines: list[list[str]], named: bool) -> dict[str, Any]:
    """DSO's, PTAM's and DPVO's lines, or the rows of a matrix."""
    if not named and len(lines) in (3, 4) and all(len(line) == len(lines) and _all_numbers(line) for line in lines):
        return {"K": [line[:3] for line in lines[:3]]}
    model, values = (lines[0][0], lines[0][1:]) if named else ("", lines[0])
    record: dict[str, Any] = {"intrinsics": values[:4], "distortion": values[4:]}
    if len(values) == 5:  # the fifth number is 0 for a pinhole, else the angle of the FOV model
        fov = float(values[4]) != 0.0
        if named and fov and model.lower() not in ("fov", "atan"):
            raise ValueError(f"{model} takes no fifth number that differs from 0")
        model, record["distortion"] = ("fov", values[4:]) if fov else ("pinhole", [])
    if model:
        record["model"] = model
    if len(lines) > 1:
        if len(lines[1]) != 2:
            raise ValueError("the second line must be the width and height of the images")
        record["width"], record["height"] = lines[1]
    if len(values) > 3 and float(values[2]) < 1 and float(values[3]) < 1:
        if len(lines) < 2:
            raise ValueError("relative to the image's size, which the second line must state")
        w, h = float(lines[1][0]), float(lines[1][1])
        scaled = [float(value) * side for value, side in zip(values[:4], (w, h, w, h), strict=True)]
        record |= {"intrinsics": scaled, CORNER_ORIGIN: True}
    return record
