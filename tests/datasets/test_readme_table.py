"""README's table by one command, from a publisher on this machine with the layouts of the real ones."""

import json
from dataclasses import replace

import pytest
from readme_recordings import archives

from edgeslam_torch.cli import main
from edgeslam_torch.datasets import catalogue

FRAMES = 60
"""Of each recording: two to six seconds."""


def publish(publisher, data, frames):
    """The catalogue's recordings with this publisher's addresses, whose archives are shorter than the real ones."""
    recordings = dict(catalogue.read_catalogue()[0])
    for name, content in archives(data, frames):
        at = f"/{name.replace('/', '_')}"
        publisher.files[at] = content
        here = {"urls": (publisher.address + at,), "size": 0, "is_exact": False, "checksum": "", "checksum_by": ""}
        recordings[name] = replace(recordings[name], archive=replace(recordings[name].archive, **here))
    return recordings


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.timeout(1200)
def test_one_command_fetches_runs_and_judges_what_readme_quotes(publisher, data_dir, tmp_path, monkeypatch, capsys):
    pytest.importorskip("pooch", reason="needs the [data] extra: pooch is not installed")
    sets = catalogue.read_catalogue()[1]
    recordings = publish(publisher, data_dir, FRAMES)
    monkeypatch.setattr(catalogue, "catalogue", lambda: (recordings, sets))
    words = ["--seeds", "1", "--no-micro", "--data", str(tmp_path / "rec"), "--out", str(tmp_path / "out")]
    assert main(["bench", "--get", "readme", "--agree", *words]) == 0
    said = capsys.readouterr().out
    record = json.loads((tmp_path / "out" / "bench.json").read_text())
    runs = {run["sequence"]: run["figures"] for run in record["runs"]}
    assert len(runs) == len(sets["readme"]) == 5
    for name, figures in runs.items():
        assert f"### {name}\n" in said
        assert figures["ate_sim3_m"] < 0.1, name
    # EuRoC has no depth maps, and two seconds of turning on the spot may leave no map to compare.
    mapped = {name for name, figures in runs.items() if figures.get("map_median_m") is not None}
    assert {"tum_fr1_xyz", "7scenes_redkitchen_seq-01", "tum_fr3_structure_notexture_far"} <= mapped
    assert "euroc_mh_05" not in mapped
    assert runs["euroc_mh_05"]["rotation_deg"] < 20.0, "the truth is the body's, turned into the camera's"
