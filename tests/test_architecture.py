"""Imports go down only, and nothing heavy loads before it is needed. The picture is in docs/architecture.md."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "edgeslam_torch"
LINKED = ("models", "losses", "train", "eval")
"""Folders at the root that are parts of the package, by links where the checkout has them."""

LAYERS: tuple[tuple[str, ...], ...] = (
    ("errors", "types", "stage_times"),
    ("files",),
    ("geometry", "config"),
    ("models", "synthetic"),
    ("losses",),
    ("optim",),
    ("frontend", "fusion"),
    ("map",),
    ("mapping",),
    ("tracking",),
    ("atlas",),
    ("atlas",),
    ("states",),
    ("slam",),
    ("drone", "calibration"),
    ("readers",),
    ("writers",),
    ("progress", "run_summary"),
    ("run",),
    ("eval",),
    ("train",),
    ("viewer", "demo"),
    ("commands",),
    ("command_line",),
    ("cli",),
)
"""From the bottom up; a part may import its own row's other parts only when `SAME_ROW` says so."""

RANK = {part: rank for rank, row in enumerate(LAYERS) for part in row}

ALLOWED_UP = {
    ("config", "fusion"),  # fusion/config.py holds its own section, and imports nothing
}
"""Exceptions, each with its reason."""

NEVER = {"evo", "djitellopy", "open3d", "torchvision", "pypose"}
"""GPL, or measured and found wanting (docs/decisions/0028); tests may use some as outside oracles."""

ORACLES = {"gtsam": "edgeslam_torch.optim.benchmark"}
"""Packages that one module may compare with when they happen to be installed."""

HEAVY = ("torch", "kornia", "cv2", "numpy", "scipy", "onnxruntime", "onnx", "matplotlib", "tensorboard", "rerun", "av")


def sources() -> list[Path]:
    """Every module of the package, each once."""
    files = [p for folder in (PACKAGE, *(ROOT / name for name in LINKED)) for p in folder.rglob("*.py")]
    return sorted({p for p in files if "__pycache__" not in p.parts})


def imported(tree: ast.AST) -> Iterator[str]:
    """Full names that a module imports, anywhere in it, except for the type checker alone."""
    skipped: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            skipped |= {id(inner) for inner in ast.walk(node)}
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are by full name"
            yield node.module or ""
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def part_of(name: str) -> str | None:
    """First part below the package of a full module name; None for other packages."""
    words = name.split(".")
    return words[1] if words[0] == "edgeslam_torch" and len(words) > 1 else None


def module_name(path: Path) -> str:
    """Full module name of a file in the package."""
    folder = PACKAGE if path.is_relative_to(PACKAGE) else ROOT
    return ".".join(("edgeslam_torch", *path.relative_to(folder).with_suffix("").parts))


PARSED = {path: list(imported(ast.parse(path.read_text(encoding="utf-8")))) for path in sources()}


@pytest.mark.parametrize("path", PARSED, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_go_down_only(path):
    own = part_of(module_name(path))
    if own == "__init__":
        return
    assert own in RANK, f"{own}: give it a place in LAYERS and in docs/architecture.md"
    for name in PARSED[path]:
        part = part_of(name)
        if part is None or part not in RANK or part == own or (own, part) in ALLOWED_UP:
            continue
        assert RANK[part] < RANK[own], f"{module_name(path)} imports {name}, which lies on the same level or above"


@pytest.mark.parametrize("path", PARSED, ids=lambda p: str(p.relative_to(ROOT)))
def test_packages_that_do_not_belong_are_not_imported(path):
    tops = {name.split(".")[0] for name in PARSED[path]}
    assert not tops & NEVER
    assert all(ORACLES[name] == module_name(path) for name in tops & ORACLES.keys())
    assert not tops & {"models", "losses", "train", "eval"}, "import edgeslam_torch.losses, not losses"


def test_train_is_imported_by_commands_only():
    users = {module_name(path) for path, names in PARSED.items() if any(part_of(n) == "train" for n in names)}
    assert {name.split(".")[1] for name in users} <= {"train", "commands"}


def loaded_by(statement: str) -> set[str]:
    """Heavy packages that a fresh interpreter has after a statement."""
    code = f"import sys; {statement}; print(' '.join(m for m in {HEAVY!r} if m in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    return set(done.stdout.split())


@pytest.mark.parametrize(
    "statement", ["import edgeslam_torch", "import edgeslam_torch.cli; edgeslam_torch.cli.available()"]
)
def test_nothing_heavy_is_imported_at_first(statement):
    assert loaded_by(statement) == set()


def test_commands_that_only_list_their_options_load_no_torch():
    code = (
        "import contextlib, sys, edgeslam_torch.cli as cli\n"
        "for name in cli.available():\n"
        "    with contextlib.suppress(SystemExit): cli.main([name, '--help'])\n"
        "    assert 'torch' not in sys.modules, f'edgeslam {name} --help loads torch'\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr


def test_root_folders_are_importable_under_the_package_only():
    for name in LINKED:
        code = (ROOT / name / "__init__.py").read_text(encoding="utf-8")
        with pytest.raises(ImportError, match=f"import edgeslam_torch.{name}, not {name}"):
            exec(compile(code, f"{name}/__init__.py", "exec"), {"__name__": name})
