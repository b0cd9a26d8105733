"""Imports go down only, as the table in docs/architecture.md says, and nothing heavy loads before it is needed."""

import ast
import re
import subprocess
import sys
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "edgeslam_torch"
LINKED = ("models", "losses", "train", "eval")
"""Folders at the root that are parts of the package, by links where the checkout has them."""


def names_in(cell):
    return {name.strip("/") for name in re.findall(r"`([\w/]+)`", cell)}


TABLE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8").split("| layer |", 1)[1].split("\n\n")[0]
CELLS = [line.strip("|").split("|") for line in TABLE.splitlines()[2:]]
LAYERS = [(names_in(parts), names_in(may_use), "all above" in may_use) for parts, _, may_use in CELLS]
"""Parts of each layer from the bottom of the house up, what they may import, and whether that is all above."""
PARTS = [part for parts, _, _ in LAYERS for part in parts]


def below(i):
    return set().union(*(parts for parts, _, _ in LAYERS[:i]))


MAY_USE = {
    part: (below(i) if is_all else may_use) | LAYERS[0][0]
    for i, (parts, may_use, is_all) in enumerate(LAYERS)
    for part in parts
}
"""Everybody may use the first row."""
NEVER = {"evo", "gtsam", "djitellopy", "open3d", "torchvision", "pypose"}
"""GPL, or measured and found wanting (docs/decisions/27-dependencies.md); tests may use some as outside oracles."""

HEAVY = "torch kornia cv2 numpy numba scipy onnxruntime onnx matplotlib tensorboard rerun av"


def module_name(path):
    root = PACKAGE if path.is_relative_to(PACKAGE) else ROOT
    return ".".join(("edgeslam_torch", *path.relative_to(root).with_suffix("").parts)).removesuffix(".__init__")


MODULES = {module_name(path): path for name in ("edgeslam_torch", *LINKED) for path in (ROOT / name).rglob("*.py")}
"""Files of the package by their full names."""


@cache
def imports(with_types=False):
    """Names that each module imports when it runs, or for the type checker too; of a module of a package the module."""
    found = {}
    for module, path in MODULES.items():
        tree = ast.parse(path.read_text(encoding="utf-8"))
        guarded = [n for n in ast.walk(tree) if isinstance(n, ast.If) and getattr(n.test, "id", "") == "TYPE_CHECKING"]
        for_types = set() if with_types else {inner for node in guarded for inner in ast.walk(node)}
        found[module] = names = set()
        for node in ast.walk(tree):
            if isinstance(node, ast.Import) and node not in for_types:
                names |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node not in for_types:
                assert node.level == 0, "imports are by full name"
                full = {f"{node.module}.{alias.name}" for alias in node.names}
                names |= full & MODULES.keys() | ({node.module} if full - MODULES.keys() else set())
    return found


@cache
def part_of(name):
    """The table's part that a full module name belongs to, the most particular one; None for other packages."""
    words = name.split(".")
    if words[0] != "edgeslam_torch" or len(words) == 1:
        return None
    path = "/".join(words[1:])
    found = [part for part in PARTS if path == part or path.startswith(f"{part}/")]
    return max(found, key=len, default=f"{path}, which is not in the table")


def test_table_names_every_part_once_and_has_no_arrow_up():
    assert len(PARTS) == len(set(PARTS)) > 30
    assert {part_of(module) for module in MODULES} - {None} == set(PARTS), "docs/architecture.md and the folders differ"
    for i, (parts, may_use, _) in enumerate(LAYERS):
        assert may_use <= below(i), f"{parts} may use {may_use - below(i)}, which does not lie below"


def test_imports_are_those_of_the_table():
    used = {(part_of(module), part_of(name)) for module, names in imports().items() for name in names}
    used = {(own, other) for own, other in used if None not in (own, other) and own != other}
    assert {(own, other) for own, other in used if other not in MAY_USE[own]} == set(), (
        "docs/architecture.md forbids it"
    )
    needless = {(*parts, other) for parts, may_use, _ in LAYERS for other in may_use
                if not used & {(part, other) for part in parts}}  # fmt: skip
    assert needless == set(), "docs/architecture.md allows what nobody imports"


def test_no_files_import_each_other_in_a_circle():
    TopologicalSorter(imports(with_types=True)).prepare()  # raises CycleError, which names the circle


def test_packages_that_do_not_belong_are_not_imported():
    tops = {(module, name.split(".")[0]) for module, names in imports().items() for name in names}
    assert {(module, top) for module, top in tops if top in NEVER or top in LINKED} == set(), (
        "import edgeslam_torch.losses, not losses"
    )


def loaded_by(statement, names=HEAVY):
    """Heavy packages that a fresh interpreter has after a statement."""
    code = f"import sys; {statement}; print(' '.join(m for m in {names!r}.split() if m in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    return set(done.stdout.split())


@pytest.mark.parametrize(
    "statement", ["import edgeslam_torch", "import edgeslam_torch.cli; edgeslam_torch.cli.available()"]
)
def test_nothing_heavy_is_imported_at_first(statement):
    assert loaded_by(statement) == set()


def test_slam_and_runs_load_neither_torch_nor_scipy_nor_a_compiler():
    names = "torch onnx matplotlib numba scipy.linalg scipy.ndimage scipy.sparse scipy.spatial scipy.special"
    compiled = "from edgeslam_torch.frontend.keypoint_grid import nearest_pixels; nearest_pixels([[0, 0]], [[1, 1]], 1)"
    loaded_by(compiled)  # a first run compiles
    imported = "import edgeslam_torch.run, edgeslam_torch.slam, edgeslam_torch.eval.report.page"
    assert loaded_by(f"{imported}; {compiled}", names) == set()


def test_commands_that_only_list_their_options_load_no_torch():
    code = (
        "import contextlib, sys, edgeslam_torch.cli as cli\n"
        "for name in cli.available():\n"
        "    with contextlib.suppress(SystemExit): cli.main([name, '--help'])\n"
        "    assert 'torch' not in sys.modules, f'edgeslam {name} --help loads torch'\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr
