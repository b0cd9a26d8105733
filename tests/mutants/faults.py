"""Single-line faults that the fast tests must notice: lists (``tests/mutants/*.toml``), and where each one goes.

A fault names a piece of code by its words, not by its line number: ``line`` must stand exactly once in the package, or
exactly once in ``at`` (a function or method by its qualified name, or a file by its name). So code may move between
files, and a list that no longer fits says so.
"""

import ast
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import cache, lru_cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LISTS = ROOT / "tests" / "mutants"
PACKAGES = ("edgeslam_torch", "eval", "losses", "models", "train")


class FaultError(Exception):
    """A fault that does not fit the code; says which and why."""


@dataclass(frozen=True, slots=True)
class Fault:
    """One line written wrong."""

    room: str
    """Stem of the list it stands in."""
    name: str
    line: str
    """Part of one line of the code."""
    put: str
    """Its replacement."""
    why: str
    """The consequence in flight if no test detects it."""
    tests: list[str]
    """Files in ``tests/`` by name, optionally ``::test_name``, or ``-k`` with an expression behind all of them."""
    at: str = ""
    survives: str = ""
    """Why no test detects it; required of every survivor."""


@dataclass(frozen=True, slots=True)
class Source:
    """A file of the package."""

    path: Path
    text: str


def load(root: Path = ROOT) -> list[Fault]:
    """Faults of all lists.

    Raises:
        FaultError: If an entry has an unknown or a missing field, or a name twice.
    """
    known = {f.name for f in fields(Fault)} - {"room"}
    faults: list[Fault] = []
    for path in sorted((root / "tests" / "mutants").glob("*.toml")):
        for entry in tomllib.loads(path.read_text(encoding="utf-8"))["fault"]:
            name = f"{path.stem}: {entry.get('name', '(no name)')}"
            if entry.keys() - known or not {"name", "line", "put", "why", "tests"} <= entry.keys():
                raise FaultError(f"{name}: fields are {sorted(entry)}, known ones {sorted(known)}")
            faults.append(Fault(room=path.stem, **entry))
    names = [f.name for f in faults]
    if doubles := {n for n in names if names.count(n) > 1}:
        raise FaultError(f"names must be unique: {sorted(doubles)}")
    return faults


def sources(root: Path = ROOT) -> list[Source]:
    """All files of the package, each once."""
    paths = [p for package in PACKAGES for p in sorted((root / package).rglob("*.py"))]
    own = [p for p in paths if not any(q.is_symlink() for q in (p, *p.relative_to(root).parents))]
    return [Source(p, p.read_text(encoding="utf-8")) for p in own if p.resolve() == p]


def applied(fault: Fault, files: list[Source]) -> tuple[Path, str]:
    """The file that a fault changes, and its text with the fault in it.

    Raises:
        FaultError: If the line stands nowhere or more than once, or the faulty file is no Python.
    """
    places = [(source, i) for source in files for i in _places(fault, source)]
    if len(places) != 1:
        where = ", ".join(f"{s.path.name}:{s.text.count(chr(10), 0, i) + 1}" for s, i in places[:5]) or "nowhere"
        raise FaultError(
            f"{fault.room}: {fault.name}: {fault.line!r} must stand once in {fault.at or 'the package'}, "
            f"it stands {where}"
        )
    source, i = places[0]
    text = source.text[:i] + fault.put + source.text[i + len(fault.line) :]
    if fault.line.split() == fault.put.split():
        raise FaultError(f"{fault.room}: {fault.name}: changes nothing")
    try:
        ast.parse(text)
    except SyntaxError as error:
        raise FaultError(f"{fault.room}: {fault.name}: {error}") from error
    return source.path, text


def _places(fault: Fault, source: Source) -> Iterator[int]:
    """Offsets of the fault's line in a file, within ``at``."""
    if fault.at.endswith(".py") and source.path.name != fault.at:
        return
    if fault.line not in source.text:
        return
    spans = [(0, len(source.text))]
    if fault.at and not fault.at.endswith(".py"):
        spans = list(_spans(source.text, fault.at))
    for begin, end in spans:
        i = source.text.find(fault.line, begin, end)
        while i >= 0:
            yield i
            i = source.text.find(fault.line, i + 1, end)


def _spans(text: str, qualified: str) -> Iterator[tuple[int, int]]:
    """Where definitions of that qualified name (``Class.method``, ``function``, ``Class``) begin and end."""
    starts = [0]
    for line in text.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))

    def walk(node: ast.AST, prefix: str) -> Iterator[tuple[int, int]]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                name = f"{prefix}{child.name}"
                if name == qualified:
                    yield starts[child.lineno - 1], starts[child.end_lineno or child.lineno]
                yield from walk(child, f"{name}.")

    yield from walk(_tree(text), "")


@cache
def _tree(text: str) -> ast.Module:
    return ast.parse(text)


@lru_cache(maxsize=1)
def _test_files(root: Path) -> list[Path]:
    return sorted((root / "tests").rglob("*.py"))


def pytest_arguments(fault: Fault, root: Path = ROOT) -> list[str]:
    """What pytest is called with for a fault.

    Raises:
        FaultError: If a test file or a test named in it is not there.
    """
    arguments: list[str] = []
    for test in fault.tests:
        if test.startswith("-k "):
            arguments += ["-k", test.removeprefix("-k ")]
            continue
        name, colons, function = test.partition("::")
        found = [path for path in _test_files(root) if path.as_posix().endswith(f"/{name}")]
        if len(found) != 1:
            raise FaultError(f"{fault.room}: {fault.name}: {len(found)} files tests/**/{name}")
        if function and f"def {function}(" not in found[0].read_text(encoding="utf-8"):
            raise FaultError(f"{fault.room}: {fault.name}: no {function} in {name}")
        arguments.append(f"{found[0].relative_to(root)}{colons}{function}")
    return arguments
