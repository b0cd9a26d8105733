"""What the package needs is declared, and what one corner needs alone is named when it is missing."""

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from edgeslam_torch.errors import MissingPackageError
from edgeslam_torch.extras import needs_extra

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = {name: wanted for name, wanted in PROJECT["optional-dependencies"].items() if name != "dev"}
IMPORTED_AS = {"opencv-python-headless": "cv2", "PyYAML": "yaml", "rerun-sdk": "rerun", "protobuf": "google"}
"""Import names that differ from the package's."""
WITH_TORCH = {"torch.utils.tensorboard": "tensorboard"}
"""Parts of a package that need another one."""
BESIDE = {"gtsam"}
"""An outside oracle, compared with where somebody has it."""


def import_names(requirements: list[str]) -> set[str]:
    """What requirements are imported as."""
    names = [match[0] for text in requirements if (match := re.match(r"[\w.-]+", text))]
    return {IMPORTED_AS.get(name, name.replace("-", "_")) for name in names}


def without_guard(node: ast.AST) -> Iterator[ast.stmt]:
    """Imports that no ``with needs_extra(...)`` and no ``if TYPE_CHECKING`` surrounds."""
    for inner in ast.iter_child_nodes(node):
        if isinstance(inner, ast.With) and "needs_extra" in ast.unparse(inner.items[0]):
            continue
        if isinstance(inner, ast.If) and "TYPE_CHECKING" in ast.unparse(inner.test):
            continue
        if isinstance(inner, ast.Import | ast.ImportFrom):
            yield inner
        yield from without_guard(inner)


def packages(statement: ast.stmt) -> set[str]:
    """Packages that an import loads."""
    if isinstance(statement, ast.ImportFrom):
        modules = [statement.module or ""]
    else:
        assert isinstance(statement, ast.Import)
        modules = [alias.name for alias in statement.names]
    return {WITH_TORCH.get(module, module.split(".")[0]) for module in modules}


def sources() -> list[Path]:
    """Every module of the package, each once."""
    folders = [ROOT / name for name in ("edgeslam_torch", "models", "losses", "train", "eval")]
    return sorted({path.resolve() for folder in folders for path in folder.rglob("*.py")})


GUARDED_BY_A_CALL = {
    "eval/report/plots.py": "commands/judging/eval.py imports it with the extra's name",
    "edgeslam_torch/readers/bags/limits.py": "`Bag` calls it where the extra is there",
    "edgeslam_torch/readers/bags/mcap_file.py": "likewise",
    "train/callbacks.py": "TensorBoard is made by `curves`, where it is installed",
}
"""Files whose importer or maker looks first."""


def test_core_imports_only_what_the_core_installs() -> None:
    core = import_names(PROJECT["dependencies"]) | set(sys.stdlib_module_names) | {"edgeslam_torch"} | BESIDE
    found = {
        f"{path.relative_to(ROOT)}: {name}"
        for path in sources()
        if not str(path.relative_to(ROOT)).startswith(tuple(GUARDED_BY_A_CALL))
        for statement in without_guard(ast.parse(path.read_text(encoding="utf-8")))
        for name in packages(statement)
        if name not in core
    }
    assert found == set()


def test_every_extra_that_the_code_names_is_declared() -> None:
    pattern = re.compile(r"""(?:needs_extra|install_command)\(\s*["'](\w+)["']""")
    named = {name for path in sources() for name in pattern.findall(path.read_text(encoding="utf-8"))}
    assert named == set(EXTRAS)


def test_missing_package_is_named_with_its_extra() -> None:
    with (
        pytest.raises(MissingPackageError, match=r"^--plots needs nosuch: pip install 'edgeslam-torch\[plots\]'$"),
        needs_extra("plots", "--plots"),
    ):
        import nosuch  # noqa: F401


def test_missing_module_of_our_own_is_a_bug() -> None:
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


def edgeslam_without_extras(*arguments: str) -> subprocess.CompletedProcess[str]:
    """The command line as a plain ``pip install .`` has it."""
    absent = set().union(*map(import_names, EXTRAS.values()))
    code = IN_AN_ENVIRONMENT_WITHOUT.format(absent=sorted(absent), arguments=list(arguments))
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


def test_export_without_its_extra_says_so_in_one_line(tmp_path: Path) -> None:
    done = edgeslam_without_extras("export", "--out", str(tmp_path / "model.onnx"))
    assert done.returncode == 1
    assert done.stderr == "edgeslam: error: edgeslam export needs onnxscript: pip install 'edgeslam-torch[export]'\n"


@pytest.mark.slow
def test_demo_needs_no_extra(tmp_path: Path) -> None:
    done = edgeslam_without_extras("demo", "--seconds", "5", "--out", str(tmp_path / "demo"))
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "demo" / "report.html").is_file()


def test_citation_has_the_version_of_the_package() -> None:
    from edgeslam_torch import __version__

    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.findall(r"^version: (.*)$", citation, re.MULTILINE) == [__version__]
    assert "version" in PROJECT["dynamic"] and "version" not in PROJECT
