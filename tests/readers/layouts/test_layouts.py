"""What holds for every layout."""

import sys

import cv2
import numpy as np
import pytest

from edgeslam_torch.errors import SourceError
from edgeslam_torch.eval.inputs.dataset import open_dataset
from edgeslam_torch.readers import layouts as package
from edgeslam_torch.readers.layouts import layout_of, layouts
from edgeslam_torch.readers.source import open_source
from edgeslam_torch.train.views.datasets import load_depth_folder

GARDEN = """
import numpy as np
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.readers.listing import ImageEntry
from edgeslam_torch.readers.sequence import DepthMaps, Sequence

KIND = "garden"


def recognises(folder):
    return (folder / "walk.txt").is_file()


def read(folder):
    images = sorted(folder.glob("*.seen.png"))
    depth = DepthMaps(0.1 * np.arange(len(images)), tuple(sorted(folder.glob("*.depth.png"))), 0.001)
    return Sequence(
        KIND,
        folder,
        tuple(ImageEntry(i, 0.1 * i, path) for i, path in enumerate(images)),
        groundtruth=folder / "walk.txt",
        camera=Camera(64, 48, 60.0, 60.0, 31.5, 23.5, source="the garden's"),
        depth=lambda: depth,
    )
"""


def test_one_new_file_is_all_that_a_data_set_needs(tmp_path, monkeypatch, write_images):
    """SLAM, evaluation and training find a layout that only its own module knows of."""
    more, folder = tmp_path / "more", tmp_path / "walk"
    more.mkdir()
    (more / "garden.py").write_text(GARDEN)
    write_images(folder, [f"{i}.seen.png" for i in range(4)])
    for i in range(4):
        cv2.imwrite(str(folder / f"{i}.depth.png"), np.full((48, 64), 2000, np.uint16))
    (folder / "walk.txt").write_text("".join(f"{0.1 * i:.1f} {i} 0 0 0 0 0 1\n" for i in range(4)))
    monkeypatch.setattr(package, "__path__", [*package.__path__, str(more)])
    layouts.cache_clear()
    try:
        source = open_source(folder)
        assert [frame.stamp_s for frame in source.frames()] == pytest.approx([0.0, 0.1, 0.2, 0.3])
        assert source.camera.source == "the garden's"
        np.testing.assert_allclose(open_dataset(folder).truth.positions[:, 0], [0.0, 1.0, 2.0, 3.0])
        views = load_depth_folder(folder).views
        assert len(views) == 4 and (views[0].depth_m == 2.0).all()
    finally:
        layouts.cache_clear()
        sys.modules.pop(f"{package.__name__}.garden", None)


def stamped(i, factor, begin_s=1305031102.2):
    return f"{(begin_s + i / 30) * factor:.{6 if factor == 1 else 0}f}"


@pytest.mark.parametrize("factor", [1, 1e3, 1e6, 1e9])
@pytest.mark.parametrize("kind", ["tum", "euroc", "kitti", "mono_vo", "mono_vo, suffixes"])
def test_stamps_of_a_layout_may_be_in_any_unit(tmp_path, write_images, kind, factor):
    lists = {
        "tum": ("rgb.txt", "rgb", "{0} rgb/{1}"),
        "euroc": ("mav0/cam0/data.csv", "mav0/cam0/data", "{0},{1}"),
        "kitti": ("times.txt", "image_0", "{0}"),
        "mono_vo": ("times.txt", "images", "{2} {0} 12.5"),
        "mono_vo, suffixes": ("times.txt", "images", "{1} {0}"),
    }
    listing, images, line = lists[kind]
    names = [f"{i:05d}.png" for i in range(12)]
    write_images(tmp_path / images, names)
    rows = [line.format(stamped(i, factor), name, name[:5]) for i, name in enumerate(names)]
    (tmp_path / listing).write_text("\n".join(rows) + "\n")
    cv2.imwrite(str(tmp_path / "vignette.png"), np.full((48, 64), 65535, np.uint16))
    source = open_source(tmp_path)
    stamps = [frame.stamp_s for frame in source.frames()]
    assert source.kind == kind.split(",")[0]
    assert np.allclose(stamps, [1305031102.2 + i / 30 for i in range(12)], atol=2e-3)


@pytest.mark.parametrize("layout", layouts(), ids=lambda layout: layout.KIND)
def test_folder_of_something_else_is_not_recognised(layout, tmp_path):
    (tmp_path / "notes.txt").write_text("")
    assert not layout.recognises(tmp_path)
    assert layout_of(tmp_path) is None


@pytest.mark.parametrize("begin", [0, 328551511918592, 1403636579763555584])
@pytest.mark.parametrize("prefix", ["", "frame_", "cam0-"])
def test_names_may_be_nanoseconds(tmp_path, write_images, begin, prefix):
    write_images(tmp_path, [f"{prefix}{begin + i * 33333333}.png" for i in range(12)])
    source = open_source(tmp_path)
    assert np.allclose(np.diff([frame.stamp_s for frame in source.frames()]), 1 / 30, rtol=1e-3)


@pytest.mark.parametrize("rows", [["0.1"], ["a 0.1", "b 0.2"]])
def test_times_that_do_not_fit_the_images_are_refused(tmp_path, write_images, rows):
    write_images(tmp_path / "images", [f"{i}.png" for i in range(4)])
    (tmp_path / "times.txt").write_text("\n".join(rows))
    with pytest.raises(SourceError, match="times.txt"):
        open_source(tmp_path)
