"""Imports go down only, as the table in docs/architecture.md says, and nothing heavy loads before it is needed."""

import ast
import re
import subprocess
import sys
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parent.parent
TABLE = ROOT / "docs" / "architecture.md"


class Row(NamedTuple):
    """A layer: parts of the package, and the parts that each of them may import."""

    parts: tuple[str, ...]
    may_use: frozenset[str]
    is_all: bool
    """Whether it says "all above" instead of names."""


def layer_table(text):
    """Rows of the table below ``| layer |``, from the bottom of the house up."""
    rows = []
    below = []
    for line in text.split("| layer |", 1)[1].splitlines()[2:]:
        if not line.startswith("|"):
            break
        parts, _, may_use = (cell.strip() for cell in line.strip("|").split("|"))
        names = _names(parts)
        is_all = may_use == "all above"
        rows.append(Row(names, frozenset(below if is_all else _names(may_use)), is_all))
        below += names
    return rows


def _names(cell):
    return tuple(name.strip("/") for name in re.findall(r"`([\w/]+)`", cell))


LAYERS = layer_table(TABLE.read_text(encoding="utf-8"))
PARTS = [part for row in LAYERS for part in row.parts]


@cache
def part_of(name):
    """The table's part that a full module name belongs to, the most particular one; None for other packages."""
    words = name.split(".")
    if words[0] != "edgeslam_torch" or len(words) == 1:
        return None
    path = "/".join(words[1:])
    found = [part for part in PARTS if path == part or path.startswith(f"{part}/")]
    return max(found, key=len, default=f"{path}, which is not in the table")


PACKAGE = ROOT / "edgeslam_torch"
LINKED = ("models", "losses", "train", "eval")
"""Folders at the root that are parts of the package, by links where the checkout has them."""

MAY_USE = {part: row.may_use | set(LAYERS[0].parts) for row in LAYERS for part in row.parts}
"""Everybody may use the first row."""

NEVER = {"evo", "gtsam", "djitellopy", "open3d", "torchvision", "pypose"}
"""GPL, or measured and found wanting (docs/decisions/27-dependencies.md); tests may use some as outside oracles."""

HEAVY = (
    "torch",
    "kornia",
    "cv2",
    "numpy",
    "numba",
    "scipy",
    "onnxruntime",
    "onnx",
    "matplotlib",
    "tensorboard",
    "rerun",
    "av",
)


def sources():
    """Every module of the package, each once."""
    files = [p for folder in (PACKAGE, *(ROOT / name for name in LINKED)) for p in folder.rglob("*.py")]
    return sorted({p for p in files if "__pycache__" not in p.parts})


class Import(NamedTuple):
    """What one statement imports."""

    names: frozenset[str]
    """Full names; of ``from package import module`` the module counts, not the package."""
    is_for_types: bool
    """Whether only the type checker follows it."""


def imports_in(node, known=frozenset(), is_for_types=False):
    """Imports inside a parsed module or statement at any depth.

    Args:
        known: Full names of modules.
    """
    if isinstance(node, ast.Import):
        yield Import(frozenset(alias.name for alias in node.names), is_for_types)
    elif isinstance(node, ast.ImportFrom):
        assert node.level == 0, "imports are by full name"
        names = {f"{node.module}.{alias.name}" for alias in node.names}
        yield Import(frozenset(names & known | ({node.module or ""} if names - known else set())), is_for_types)
    is_for_types |= isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING"
    for part in ("body", "orelse", "finalbody", "handlers", "cases"):  # no import stands in an expression
        for inner in getattr(node, part, ()):
            yield from imports_in(inner, known, is_for_types)


def forbidden(module, names):
    """Imports of a module that the table does not allow."""
    own = part_of(module)
    if own is None:
        return []
    allowed = MAY_USE.get(own, frozenset())
    return [name for name in names if part_of(name) not in {None, own, *allowed}]


def module_name(path):
    """Full module name of a file in the package."""
    folder = PACKAGE if path.is_relative_to(PACKAGE) else ROOT
    return ".".join(("edgeslam_torch", *path.relative_to(folder).with_suffix("").parts)).removesuffix(".__init__")


MODULES = frozenset(module_name(path) for path in sources())


@cache
def all_imports():
    """Imports of each module of the package, by its full name."""
    return {
        module_name(path): list(imports_in(ast.parse(path.read_text(encoding="utf-8")), MODULES)) for path in sources()
    }


@cache
def imports():
    """Names that each module of the package imports when it runs."""
    return {
        module: [name for each in found if not each.is_for_types for name in each.names]
        for module, found in all_imports().items()
    }


def test_table_names_every_part_once_and_nothing_else():
    assert len(PARTS) == len(set(PARTS)) > 30
    homes = {part_of(module) for module in MODULES} - {None}
    assert homes == set(PARTS), "docs/architecture.md and the folders differ"


def test_table_has_no_arrow_up():
    for i, row in enumerate(LAYERS):
        below = {part for lower in LAYERS[:i] for part in lower.parts}
        assert row.may_use <= below, f"{row.parts} may use {set(row.may_use - below)}, which does not lie below"


def test_imports_are_those_of_the_table():
    found = {module: forbidden(module, names) for module, names in imports().items()}
    assert {module: names for module, names in found.items() if names} == {}, "docs/architecture.md does not allow it"


def test_no_files_import_each_other_in_a_circle():
    graph = {module: {name for each in found for name in each.names} for module, found in all_imports().items()}
    TopologicalSorter(graph).prepare()  # raises CycleError, which names the circle


def test_table_allows_only_imports_in_use():
    used = {(part_of(module), part_of(name)) for module, names in imports().items() for name in names}
    rows = [row for row in LAYERS if not row.is_all]
    needless = [
        (row.parts, other) for row in rows for other in row.may_use if not used & {(p, other) for p in row.parts}
    ]
    assert needless == []


def test_packages_that_do_not_belong_are_not_imported():
    tops = {module: {name.split(".")[0] for name in names} for module, names in imports().items()}
    users = {name: {module for module, found in tops.items() if name in found} for name in {*NEVER, *LINKED}}
    assert {name: users[name] for name in NEVER if users[name]} == {}
    assert {name: users[name] for name in LINKED if users[name]} == {}, "import edgeslam_torch.losses, not losses"


def loaded_by(statement, names=HEAVY):
    """Heavy packages that a fresh interpreter has after a statement."""
    code = f"import sys; {statement}; print(' '.join(m for m in {names!r} if m in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    return set(done.stdout.split())


@pytest.mark.parametrize(
    "statement", ["import edgeslam_torch", "import edgeslam_torch.cli; edgeslam_torch.cli.available()"]
)
def test_nothing_heavy_is_imported_at_first(statement):
    assert loaded_by(statement) == set()


def test_slam_and_runs_load_neither_torch_nor_scipy_nor_a_compiler():
    parts = [f"scipy.{part}" for part in ("linalg", "ndimage", "sparse", "spatial", "special")]
    names = ["torch", "onnx", "matplotlib", "numba", *parts]
    compiled = "from edgeslam_torch.frontend.keypoint_grid import nearest_pixels; nearest_pixels([[0, 0]], [[1, 1]], 1)"
    loaded_by(compiled)  # a first run compiles
    assert (
        loaded_by(f"import edgeslam_torch.run, edgeslam_torch.slam, edgeslam_torch.eval.report.page; {compiled}", names)
        == set()
    )


def test_commands_that_only_list_their_options_load_no_torch():
    code = (
        "import contextlib, sys, edgeslam_torch.cli as cli\n"
        "for name in cli.available():\n"
        "    with contextlib.suppress(SystemExit): cli.main([name, '--help'])\n"
        "    assert 'torch' not in sys.modules, f'edgeslam {name} --help loads torch'\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr
