"""Archives, kind and hostile."""

import bz2
import gzip
import io
import lzma
import tarfile

import pytest
from published import tgz, zipped

from edgeslam_torch.datasets.unpack import member_ending, unpack
from edgeslam_torch.errors import SourceError


@pytest.fixture
def put(tmp_path):
    """Function that writes an archive and unpacks a part of it; returns what came out by name."""

    def unpacked(content, inside="", name="a.tgz"):
        archive = tmp_path / name
        archive.write_bytes(content)
        target = tmp_path / "target"
        target.mkdir()
        unpack(archive, inside, target)
        return {str(p.relative_to(target)): p.read_bytes() for p in sorted(target.rglob("*")) if p.is_file()}

    return unpacked


def test_named_folder_is_left_out_and_nothing_beside_it_is_taken(put):
    content = tgz({"./set/rgb.txt": b"1", "./set/rgb/1.png": b"22", "other/x": b"3"})
    assert put(content, "set") == {"rgb.txt": b"1", "rgb/1.png": b"22"}


def test_archive_in_an_archive_is_unpacked_and_the_others_are_not(put, tmp_path):
    inner = zipped({"seq-01/frame-0.png": b"1", "seq-01/Thumbs.db": b"junk"})
    outer = zipped({"kitchen/seq-01.zip": inner, "kitchen/seq-02.zip": b"x" * 10})
    assert put(outer, "kitchen/seq-01.zip", "kitchen.zip") == {"frame-0.png": b"1"}
    assert sorted(p.name for p in tmp_path.iterdir()) == ["kitchen.zip", "target"]


@pytest.mark.parametrize("name", ["../evil", "a/../../evil", "/evil", "a\\..\\..\\evil", "C:evil"])
@pytest.mark.parametrize("make", [tgz, zipped])
def test_path_outside_is_refused_and_nothing_unpacked(put, tmp_path, name, make):
    with pytest.raises(SourceError, match="would lie outside the folder; nothing was unpacked"):
        put(make({"good": b"1", name: b"2"}))
    assert list((tmp_path / "target").iterdir()) == []
    assert not (tmp_path / "evil").exists()


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.FIFOTYPE, tarfile.CHRTYPE])
def test_links_and_devices_in_a_tar_are_refused(put, tmp_path, kind):
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w:gz") as archive:
        info = tarfile.TarInfo("rgb")
        info.type, info.linkname = kind, "/etc"
        archive.addfile(info)
    with pytest.raises(SourceError, match="'rgb' is a link or a device"):
        put(out.getvalue())
    assert list((tmp_path / "target").iterdir()) == []


def test_bomb_is_refused_before_it_is_unpacked(put, tmp_path):
    with pytest.raises(SourceError, match="too much for a recording"):
        put(tgz({"rgb.txt": bytes(40 << 20)}))
    assert list((tmp_path / "target").iterdir()) == []


def test_one_file_by_the_end_of_its_path(tmp_path):
    archive = tmp_path / "gt.zip"
    archive.write_bytes(zipped({"x/mono_gt/ME000.txt": b"1 2", "x/stereo_gt/ME000.txt": b"3"}))
    assert member_ending(archive, "mono_gt/ME000.txt") == b"1 2"
    with pytest.raises(SourceError, match="has 2 files ME000.txt, not one"):
        member_ending(archive, "ME000.txt")


def pax_of(size):
    """A tar whose extended header has so many bytes."""
    entry = tarfile.TarInfo("header")
    entry.type, entry.size = tarfile.XHDTYPE, size
    return entry.tobuf() + bytes(-(-size // 512) * 512) + tarfile.TarInfo("a").tobuf() + bytes(1024)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"<html>moved</html>",
        tgz({"a": bytes(range(256)) * 99})[:-50],
        b"\xfd7zXZ\x00\x00\x04" + bytes(200),
        lzma.compress(bytes(5000))[:-30],
        bz2.compress(bytes(5000))[:-9],
        lambda: gzip.compress(pax_of(64 << 20)),
        pax_of(600).replace(bytes(600), b"999999999999 path=" + bytes(582), 1),
    ],
    ids=["empty", "page", "cut", "xz", "cut xz", "cut bz2", "long header", "odd header"],
)
def test_damaged_and_odd_archives_are_one_line(put, content):
    with pytest.raises(SourceError, match="a.tgz: damaged, or no archive") as caught:
        put(content() if callable(content) else content)
    assert "\n" not in str(caught.value)
