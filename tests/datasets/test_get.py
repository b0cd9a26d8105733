"""``edgeslam data get`` from a publisher on this machine."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from published import png, tgz, zipped

from edgeslam_torch.cli import main
from edgeslam_torch.datasets import catalogue, consent, store
from edgeslam_torch.files import download
from edgeslam_torch.readers.source import open_source


def tum(count=4, name="rgbd_dataset_freiburg1_xyz"):
    """A recording as TUM publishes it."""
    rgb = {f"{name}/rgb/{i}.png": png(i) for i in range(count)}
    lists = {
        f"{name}/rgb.txt": "".join(f"{i}.0 rgb/{i}.png\n" for i in range(count)).encode(),
        f"{name}/groundtruth.txt": b"".join(b"%d 0 0 %d 0 0 0 1\n" % (i, i) for i in range(count)),
    }
    return tgz({**rgb, **lists})


@pytest.fixture
def shop(publisher, tmp_path, monkeypatch):
    """Function that puts archives into a catalogue of its own."""

    def stocked(*archives, layout="tum"):
        text = '[sets]\n[[collection]]\nname = "Set"\npage = "https://x"\nlicence = "L"\nterms = "https://t"\n'
        text += f'cite = "C"\nlayout = "{layout}"\n'
        for fields in archives:
            names = ", ".join(f'"{name}" = "{inside}"' for name, inside in fields.pop("sequences").items())
            text += "[[collection.archive]]\n" + "".join(f"{k} = {json.dumps(v)}\n" for k, v in fields.items())
            text += f"sequences = {{ {names} }}\n"
        path = tmp_path / "catalogue.toml"
        path.write_text(text)
        read = catalogue.read_catalogue(path)
        monkeypatch.setattr(catalogue, "catalogue", lambda: read)

    return stocked


@pytest.fixture
def one(shop, publisher):
    """Function that offers one recording ``tum_fr1_a`` of some content."""

    def offered(content, **fields):
        publisher.files["/a.tgz"] = content
        urls = fields.pop("urls", [f"{publisher.address}/a.tgz"])
        shop({"urls": urls, "sequences": {"tum_fr1_a": "rgbd_dataset_freiburg1_xyz"}, **fields})

    return offered


def get(tmp_path, *words):
    return main(["data", "get", *words, "--to", str(tmp_path / "rec"), "--agree"])


def sha256(content):
    return hashlib.sha256(content).hexdigest()


def test_recording_is_ready_to_run_and_says_where_it_comes_from(one, publisher, tmp_path, capsys):
    content = tum()
    one(content, bytes=len(content), checksum=f"sha256:{sha256(content)}", checksum_by="agreed")
    assert get(tmp_path, "tum_fr1_a") == 0
    said = capsys.readouterr().out
    assert "Licence: L (https://t)" in said
    assert "the checksum that independent projects recorded" in said
    source = open_source(tmp_path / "rec" / "tum_fr1_a")
    assert len(list(source.frames())) == 4
    assert "freiburg1" in source.camera.source, "the folder's name tells the camera"
    origin = json.loads((tmp_path / "rec" / "tum_fr1_a" / ".origin.json").read_text())
    assert (origin["licence"], origin["sha256"]) == ("L", sha256(content))
    assert [p.name for p in (tmp_path / "rec" / ".downloads").iterdir()] == ["a.tgz.sha256"], "the archive is gone"
    assert publisher.agents == {download.USER_AGENT}, "some servers refuse Python's own"


@pytest.mark.parametrize("changed", [None, tum(6)])
def test_broken_download_goes_on_in_the_next_call_or_begins_anew_if_the_file_changed(
    one, publisher, tmp_path, capsys, changed
):
    one(tum())
    publisher.breaks["/a.tgz"] = 1000
    part = tmp_path / "rec" / ".downloads" / "a.tgz.http.part"
    content, fetch = publisher.files["/a.tgz"], download.fetch

    def vanish(url, part, most, progress):  # the publisher is gone after the first piece
        try:
            fetch(url, part, most, progress)
        finally:
            publisher.files.pop("/a.tgz", None)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(download, "fetch", vanish)
        assert get(tmp_path, "tum_fr1_a") == 1
    assert "run the same command to resume" in capsys.readouterr().err
    assert part.stat().st_size == 1000
    assert not (tmp_path / "rec" / "tum_fr1_a").exists()
    publisher.files["/a.tgz"] = content if changed is None else changed
    publisher.requests.clear()
    assert get(tmp_path, "tum_fr1_a") == 0
    assert publisher.requests == [("/a.tgz", "bytes=1000-")]
    assert len(list(open_source(tmp_path / "rec" / "tum_fr1_a").frames())) == (4 if changed is None else 6)


def test_missing_file_is_named_with_a_way_out_and_the_next_address_is_tried(one, publisher, tmp_path, capsys):
    one(tum(), urls=[f"{publisher.address}/gone.tgz"])
    assert get(tmp_path, "tum_fr1_a") == 1
    error = capsys.readouterr().err
    assert "/gone.tgz (Not Found)" in error
    assert "--archive FILE" in error
    one(tum(), urls=[f"{publisher.address}/gone.tgz", f"{publisher.address}/a.tgz"])
    assert get(tmp_path, "tum_fr1_a") == 0


def test_first_download_is_trusted_and_a_changed_second_one_is_not(one, publisher, tmp_path, capsys):
    one(tum())
    assert get(tmp_path, "tum_fr1_a") == 0
    assert "trusted on first use: no checksum is known, and it came unencrypted" in capsys.readouterr().out
    target = tmp_path / "rec" / "tum_fr1_a"
    target.rename(tmp_path / "rec" / "aside")
    publisher.files["/a.tgz"] = tum(5)
    assert get(tmp_path, "tum_fr1_a") == 1
    error = capsys.readouterr().err
    assert "not the expected file" in error
    assert not target.exists()
    Path(error.split("remove ")[1].strip()).unlink()
    assert get(tmp_path, "tum_fr1_a") == 0


def test_a_bad_first_answer_is_not_what_the_next_must_match(one, publisher, tmp_path):
    for bad in (b"<html>try again later</html>", tum()[:-20], tgz({"other/rgb.txt": b"1.0 rgb/1.png\n"}), b""):
        one(bad)
        assert get(tmp_path, "tum_fr1_a") == 1
    for missing in (-1, 1):
        one(tum(), bytes=len(tum()) + missing)
        assert get(tmp_path, "tum_fr1_a") == 1
        assert not (tmp_path / "rec" / "tum_fr1_a").exists()
    one(tum())
    assert get(tmp_path, "tum_fr1_a") == 0


def test_two_recordings_of_one_archive_are_one_download(shop, publisher, tmp_path):
    def scene(number):
        names = [f"frame-{i:06d}" for i in range(3)]
        pose = "\n".join("\t".join(str(float(x)) for x in row) for row in np.eye(4)).encode()
        files = {f"seq-{number:02d}/{n}.color.png": png(number) for n in names}
        return zipped(files | {f"seq-{number:02d}/{n}.pose.txt": pose for n in names})

    publisher.files["/k.zip"] = zipped({f"k/seq-{i:02d}.zip": scene(i) for i in (1, 2)})
    names = {f"7scenes_k_{i}": f"k/seq-{i:02d}.zip" for i in (1, 2)}
    shop({"urls": [f"{publisher.address}/k.zip"], "sequences": names}, layout="7scenes")
    assert get(tmp_path, "7scenes_k_*") == 0
    assert len(publisher.requests) == 1
    for name in names:
        assert open_source(tmp_path / "rec" / name).groundtruth is not None


def test_space_counts_an_archive_once_and_of_it_only_what_is_unpacked(shop, tmp_path):
    names = {f"s{i}": f"k/{i}.zip" for i in range(10)}
    shop({"urls": ["https://x/k.zip"], "bytes": 10_000_000_000, "sequences": names})
    one, two = (store.needed_bytes(catalogue.chosen(words), tmp_path) for words in (["s1"], ["s1", "s2"]))
    assert 11e9 < one < 13e9, "the archive, the one in it, and a tenth unpacked"
    assert two - one == pytest.approx(one - 10e9)


def test_folder_of_something_else_is_not_touched(one, publisher, tmp_path, capsys):
    one(tum())
    mine = tmp_path / "rec" / "tum_fr1_a"
    mine.mkdir(parents=True)
    (mine / "notes").touch()
    assert get(tmp_path, "tum_fr1_a") == 1
    assert "was not fetched by 'edgeslam data get'" in capsys.readouterr().err
    assert publisher.requests == []


@pytest.mark.parametrize(("answer", "code"), [("y\n", 0), ("yes\n", 0), ("n\n", 1), ("\n", 1), ("", 1)])
def test_licence_is_asked_for(one, publisher, tmp_path, monkeypatch, answer, code):
    one(tum())

    class Terminal:
        def isatty(self):
            return True

        def readline(self):
            return answer

    monkeypatch.setattr(consent.sys, "stdin", Terminal())
    assert main(["data", "get", "tum_fr1_a", "--to", str(tmp_path / "rec")]) == code
    assert bool(publisher.requests) == (code == 0)
