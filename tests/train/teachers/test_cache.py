"""The teacher's depth, kept for other trainings."""

import argparse
import os
from pathlib import Path

import numpy as np
import pytest

from edgeslam_torch.commands.training._inputs import check_shared, teacher_cache
from edgeslam_torch.errors import ConfigError
from edgeslam_torch.train.teachers import plane_sweep
from edgeslam_torch.train.teachers.cache import IN_USE_S, TeacherCache


def test_entry_is_of_its_content(tmp_path, monkeypatch):
    cache = TeacherCache(tmp_path)
    first = cache.entry("kitchen", "images and poses", "network", "0.1")
    assert first.is_dir()
    assert cache.entry("kitchen", "images and poses", "network", "0.1") == first
    assert cache.entry("kitchen", "images and poses", "network", "0.2") != first
    assert cache.entry("kitchen", "other images", "network", "0.1") != first
    monkeypatch.setattr(plane_sweep, "WINDOW", 7)
    assert cache.entry("kitchen", "images and poses", "network", "0.1") != first


def test_what_was_used_longest_ago_goes_first(tmp_path):
    cache = TeacherCache(tmp_path, most_bytes=2500)
    entries = [cache.entry(f"run{k}", "content") for k in range(4)]
    for age, entry in zip((9, 7, 8, 1), entries, strict=True):
        np.save(entry / "swept_0.npy", np.zeros(872, np.uint8))  # 1000 bytes with its header
        os.utime(entry, (1e9 - age, 1e9 - age))
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "mine.txt").write_text("x" * 5000)
    assert cache.shrink(now_s=1e9 + IN_USE_S + 5) == [entries[0].name, entries[2].name]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([entries[1].name, entries[3].name, "notes"])
    assert cache.shrink(now_s=1e9 + IN_USE_S + 5) == []


def test_what_may_be_in_use_stays(tmp_path):
    cache = TeacherCache(tmp_path, most_bytes=10)
    entry = cache.entry("run", "content")
    np.save(entry / "swept_0.npy", np.zeros(100))
    assert cache.shrink() == []
    assert cache.shrink(now_s=entry.stat().st_mtime + IN_USE_S + 1) == [entry.name]


def test_new_folder_is_empty(tmp_path):
    assert TeacherCache(tmp_path / "none").shrink() == []


@pytest.mark.parametrize("words", [{"cache_gb": 0.0}, {"cache_gb": float("nan")}, {"cache": Path(__file__)}])
def test_mistakes_are_named(words):
    given = {"threads": 1, "max_frames": None, "device": "cpu", "cache": None, "cache_gb": 10.0} | words
    with pytest.raises(ConfigError, match=r"--cache"):
        check_shared(argparse.Namespace(**given))


def test_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    cache = teacher_cache(argparse.Namespace(cache=tmp_path / "file" / "in", cache_gb=1.0))
    assert cache is not None
    with pytest.raises(ConfigError, match=r"--cache .*cannot be written to"):
        cache.entry("run", "content")
