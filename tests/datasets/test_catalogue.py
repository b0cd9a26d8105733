"""The project's own catalogue, and what names stand for."""

import re

import pytest

from edgeslam_torch.datasets.catalogue import catalogue, chosen
from edgeslam_torch.datasets.prepare import PREPARED
from edgeslam_torch.errors import ConfigError


def test_every_entry_can_be_fetched_and_says_its_terms():
    recordings, sets = catalogue()
    assert len(recordings) > 100
    for recording in recordings.values():
        archive, collection = recording.archive, recording.collection
        assert collection.layout in PREPARED
        assert collection.licence and collection.terms.startswith("https://") and collection.cite
        assert all(url.startswith("https://") for url in archive.urls) or archive.doubt, recording.name
        assert re.fullmatch("sha256:[0-9a-f]{64}|md5:[0-9a-f]{32}|", archive.checksum), recording.name
        assert bool(archive.checksum) == (archive.checksum_by in ("publisher", "agreed"))
        assert re.fullmatch(r"[\w.-]+(/[\w.-]+)?", recording.name)
    for names in sets.values():
        assert set(names) <= recordings.keys()


def test_names_patterns_and_sets_stand_for_recordings_once():
    assert [r.name for r in chosen(["tum_fr1_xyz", "tum_fr1_*z", "tum_fr1_desk"])] == ["tum_fr1_xyz", "tum_fr1_desk"]
    assert "7scenes_redkitchen/seq-01" in [r.name for r in chosen(["readme"])]
    assert [r.name for r in chosen(["7scenes_heads/*"])] == ["7scenes_heads/seq-01", "7scenes_heads/seq-02"]


def test_mistyped_name_gets_a_suggestion():
    with pytest.raises(ConfigError, match="no recording called 'tum_fr1_xzy'; did you mean tum_fr1_xyz"):
        chosen(["tum_fr1_xzy"])
