"""What the package needs is declared, and what one corner needs alone is named when it is missing."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from edgeslam_torch.errors import MissingPackageError
from edgeslam_torch.extras import needs_extra

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = {name: wanted for name, wanted in PROJECT["optional-dependencies"].items() if name != "dev"}
IMPORTED_AS = {"opencv-python-headless": "cv2", "PyYAML": "yaml", "rerun-sdk": "rerun", "protobuf": "google"}
"""Import names that differ from the package's."""


def import_names(requirements):
    """What requirements are imported as."""
    names = [match[0] for text in requirements if (match := re.match(r"[\w.-]+", text))]
    return {IMPORTED_AS.get(name, name.replace("-", "_")) for name in names}


def test_missing_package_is_named_with_its_extra():
    with (
        pytest.raises(MissingPackageError, match=r"^--plots needs nosuch: pip install 'edgeslam-torch\[plots\]'$"),
        needs_extra("plots", "--plots"),
    ):
        import nosuch  # noqa: F401


def test_missing_module_of_our_own_is_a_bug():
    with pytest.raises(ModuleNotFoundError), needs_extra("plots", "--plots"):
        import edgeslam_torch.nosuch  # noqa: F401


IN_AN_ENVIRONMENT_WITHOUT = """
import sys
from importlib.abc import MetaPathFinder

class Absent(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {absent}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Absent())
from edgeslam_torch.cli import main
sys.exit(main({arguments}))
"""


def edgeslam_without_extras(*arguments):
    """The command line as a plain ``pip install .`` has it."""
    absent = set().union(*map(import_names, EXTRAS.values()))
    code = IN_AN_ENVIRONMENT_WITHOUT.format(absent=sorted(absent), arguments=list(arguments))
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


def test_export_without_its_extra_says_so_in_one_line(tmp_path):
    done = edgeslam_without_extras("export", "--out", str(tmp_path / "model.onnx"))
    assert done.returncode == 1
    assert done.stderr == "edgeslam: error: edgeslam export needs onnxscript: pip install 'edgeslam-torch[export]'\n"


@pytest.mark.slow
def test_demo_needs_no_extra(tmp_path):
    done = edgeslam_without_extras("demo", "--seconds", "5", "--out", str(tmp_path / "demo"))
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "demo" / "report.html").is_file()
