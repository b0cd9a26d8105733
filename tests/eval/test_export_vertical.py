"""Every exported map says whether z is up."""

import json

import pytest

from edgeslam_torch.cli import main
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.camera_file import save_camera

KNOWN = {"source": "edges", "sigma_deg": 1.24}


@pytest.mark.parametrize(
    ("up", "said"),
    [
        (KNOWN, "z up by edges, sigma 1.2 degrees"),
        ({"source": "unknown", "sigma_deg": None}, "up is not known"),
        (None, "up is not known"),
        ([KNOWN], "up is not known"),
        ({"source": "edges"}, "up is not known"),
        ({"source": 3, "sigma_deg": "x"}, "up is not known"),
    ],
)
@pytest.mark.parametrize(
    ("form", "file"),
    [("ply", ""), ("pcd", ""), ("las", ""), ("colmap", "points3D.txt"), ("colmap", "images.txt")],
)
def test_exports_say_whether_up_is_known(run_folder, tmp_path, capsys, form, file, up, said):
    if form == "las":
        pytest.importorskip("laspy")
    run_dir = tmp_path / "run"
    run_folder(run_dir)
    save_camera(run_dir / "camera.yaml", Camera(640, 480, 500.0, 500.0, 319.5, 239.5))
    summary = json.loads((run_dir / "summary.json").read_text())
    (run_dir / "summary.json").write_text(json.dumps({**summary, "up": up}))
    out = tmp_path / "out"
    assert main(["export-map", str(run_dir), "--format", form, "-o", str(out)]) == 0
    assert said in capsys.readouterr().out
    assert said.encode() in (out / file if file else out).read_bytes()[:10000]
