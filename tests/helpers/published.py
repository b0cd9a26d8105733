"""Small archives as the publishers of recordings make them."""

import io
import tarfile
import zipfile

import cv2
import numpy as np


def png(value=90, dtype=np.uint8):
    """A small picture that does not compress well."""
    rng = np.random.default_rng(value)
    return cv2.imencode(".png", rng.integers(0, 255, (48, 64), dtype=dtype))[1].tobytes()


def tgz(files):
    """An archive as TUM and ICL-NUIM publish them."""
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w:gz") as archive:
        for name, content in files.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))
    return out.getvalue()


def zipped(files):
    """An archive as 7-Scenes and EuRoC publish them."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return out.getvalue()
