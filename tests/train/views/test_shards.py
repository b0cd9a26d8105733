"""Images with depth in tar files: what is written is read, in place, and what is wrong is named."""

import gzip
import io
import json
import tarfile

import cv2
import numpy as np
import pytest

from edgeslam_torch.errors import SourceError
from edgeslam_torch.train import folder
from edgeslam_torch.train.recipes.finetune import HELD_OUT, MOST_HELD_OUT, _split
from edgeslam_torch.train.views.augment import View
from edgeslam_torch.train.views.datasets import DepthFolder
from edgeslam_torch.train.views.shards import is_sharded, load_shards, write_shards

K = np.array([[40.0, 0.0, 15.5], [0.0, 41.0, 11.5], [0.0, 0.0, 1.0]])


def views(count):
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (count, 24, 32, 3), np.uint8)
    return [View(image, np.full((24, 32), 1.0 + 0.25 * i, np.float32), K) for i, image in enumerate(images)]


def tar(path, files):
    with tarfile.open(path, "w") as out:
        for name, content in files.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(content)
            out.addfile(entry, io.BytesIO(content))
    return path


def sample(name="a", **other):
    image = cv2.imencode(".jpg", np.full((24, 32, 3), 90, np.uint8))[1].tobytes()
    depth = io.BytesIO()
    np.save(depth, np.full((24, 32), 2.5))
    camera = json.dumps({"fx": 40, "fy": 41, "cx": 15.5, "cy": 11.5}).encode()
    return {
        f"{name}.{k.replace('_', '.')}": v
        for k, v in ({"jpg": image, "depth_npy": depth.getvalue(), "json": camera} | other).items()
    }


def test_what_is_written_is_read(tmp_path):
    given = views(7)
    written = write_shards(given, tmp_path, "flight", per_shard=3)
    assert [path.name for path in written] == ["flight-000000.tar", "flight-000003.tar", "flight-000006.tar"]
    assert is_sharded(tmp_path)
    assert is_sharded(written[0])
    folder = load_shards(tmp_path)
    assert len(folder.views) == 7
    for mine, theirs in zip(given, folder.views, strict=True):
        assert np.array_equal(mine.image, theirs.image)
        np.testing.assert_allclose(theirs.depth_m, mine.depth_m, atol=5e-4)
        np.testing.assert_allclose(theirs.K, K)
    assert len(load_shards(tmp_path, max_frames=2).views) == 2
    assert load_shards(tmp_path, width=16).views[0].image.shape == (12, 16, 3)
    assert load_shards(tmp_path, width=16).views[0].K[0, 0] == pytest.approx(20.0)


def test_files_of_others_in_metres_and_in_their_own_unit(tmp_path):
    stored = cv2.imencode(".png", np.full((24, 32), 5000, np.uint16))[1].tobytes()
    camera = json.dumps({"fx": 40, "fy": 41, "cx": 15, "cy": 11, "depth_per_m": 5000}).encode()
    files = {**sample("x/a"), **sample("x/b.", depth_png=stored, json=camera), "README": b"not a sample"}
    del files["x/b..depth.npy"]
    files = {name.replace("b..", "b."): content for name, content in files.items()}
    folder = load_shards(tar(tmp_path / "theirs.tar", files))
    assert [float(v.depth_m.max()) for v in folder.views] == [2.5, 1.0]
    assert folder.left_out == ("theirs.tar: README has no image",)


@pytest.mark.parametrize(
    ("other", "why"),
    [
        ({"jpg": b"no image"}, "jpg: cannot be decoded"),
        ({"depth_npy": b"no array"}, "cannot be read"),
        ({"json": b"{}"}, "cannot be read"),
        ({"json": b'{"fx": NaN, "fy": 1, "cx": 0, "cy": 0}'}, "are not a calibration"),
        ({"json": b"[]"}, "cannot be read"),
        ({"depth_png": cv2.imencode(".png", np.zeros((24, 30), np.uint16))[1].tobytes()}, "depth .* of an image"),
        ({"depth_png": cv2.imencode(".png", np.zeros((24, 32), np.uint8))[1].tobytes()}, "no 16-bit image"),
    ],
)
def test_damaged_sample_is_named_when_it_is_drawn(tmp_path, other, why):
    folder = load_shards(tar(tmp_path / "bad.tar", {**sample("good"), **sample("bad", **other)}))
    assert folder.views[0].depth_m.max() == 2.5
    with pytest.raises(
        SourceError, match=rf"bad\.tar: bad cannot be read \(.*{'' if why == 'cannot be read' else why}"
    ):
        folder.views[1]


def test_shards_that_are_none_are_named(tmp_path):
    whole = tar(tmp_path / "whole.tar", sample()).read_bytes()
    cases = {
        "packed.tar": (gzip.compress(whole), "compressed ones: gunzip"),
        "text.tar": (b"hello", "no tar file that can be read"),
        "cut.tar": (whole[:1000], "is cut off|unexpected end"),
    }
    for name, (content, why) in cases.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(SourceError, match=f"{name}: .*({why})"):
            load_shards(tmp_path / name)
    with pytest.raises(SourceError, match=r"no sample of image, depth and calibration \(half.tar: a has no depth\)"):
        load_shards(tar(tmp_path / "half.tar", {k: v for k, v in sample().items() if "depth" not in k}))


class _Counted(list[View]):
    read = 0

    def __getitem__(self, index):
        self.read += 1
        return super().__getitem__(index)


@pytest.mark.parametrize("count", [2, 9, 10, 11, 25, HELD_OUT * MOST_HELD_OUT + 5])
def test_views_are_divided_without_reading_those_to_learn_from(count):
    marked = [View(np.zeros((1, 1, 3), np.uint8), np.full((1, 1), i, np.float32), K) for i in range(count)]
    counted = _Counted(marked)
    (source,), held_out = _split([DepthFolder("a", counted, ())], keep_all=False)
    assert counted.read == len(held_out) <= MOST_HELD_OUT
    number = [int(v.depth_m[0, 0]) for v in held_out]
    rest = [int(source.views[i].depth_m[0, 0]) for i in range(len(source.views))]
    assert sorted(number + rest) == list(range(count))


def test_record_changes_with_the_content_and_reads_no_sample(tmp_path):
    write_shards(views(3), tmp_path, "flight")
    first = folder.content(load_shards(tmp_path))
    assert first.startswith("3, ")
    assert folder.content(load_shards(tmp_path)) == first
    write_shards(views(4)[1:], tmp_path, "flight")
    assert folder.content(load_shards(tmp_path)) != first
