"""What the documents say of the program: commands, imports, links, and the files that a run writes."""

import ast
import importlib
import re
import shlex
import sys
from pathlib import Path
from pkgutil import resolve_name

import pytest

from edgeslam_torch import cli
from edgeslam_torch.command_line import full_parser

pytest.importorskip("griffe", reason="the documentation's tools are not installed")
ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "docs" / "building"))
from reference import NAMES, PACKAGES, commands_page  # noqa: E402  # beside the documents, outside the package

DOCS = [ROOT / f"{name}.md" for name in ("README", "CHANGELOG", "CONTRIBUTING", "SECURITY")]
DOCS += sorted(path for path in (ROOT / "docs").rglob("*.md") if "building" not in path.parts)
GUIDES = [path for path in DOCS if path.parent.name in ("start", "guides") or path.name == "README.md"]
TAKES_WEIGHTS = {"finetune", "distil"}
"""Commands that refuse weights which are not there; of them the options alone are compared."""


def commands():
    """Page and line of each command in a block of code."""
    return [
        (page.name, line)
        for page in GUIDES
        for line in re.findall(
            r"^(?:    )?(?:\$ )?(edgeslam [a-z][^\n]+)$", page.read_text(encoding="utf-8"), re.MULTILINE
        )
    ]


def test_every_command_is_one_that_the_program_takes(capsys):
    parser, wrong = full_parser(cli.available()), []
    for page, line in commands():
        words = [word for word in shlex.split(line, comments=True)[1:] if word != "..."]
        try:
            if words[0] in TAKES_WEIGHTS:
                options = {word for word in words if word.startswith("--")}
                wrong += [(page, line, "")] if options - option_names(words[0]) else []
            else:
                parser.parse_args(words)
        except SystemExit as end:
            if end.code:
                wrong.append((page, line, capsys.readouterr().err.strip()))
    assert wrong == [] and len(commands()) > 40


def option_names(command):
    return set(re.findall(r"--[a-z][\w-]*", commands_page().split(f"\n## edgeslam {command}\n")[1].split("\n## ")[0]))


def imports():
    """Module and name of what Python code in the documents imports from the package."""
    blocks = [
        block
        for page in DOCS
        for block in re.findall(r"^```python\n(.*?)^```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    ]
    nodes = [node for block in blocks for node in ast.walk(ast.parse(block)) if isinstance(node, ast.ImportFrom)]
    ours = [node for node in nodes if (node.module or "").startswith("edgeslam_torch")]
    return {(str(node.module), name.name) for node in ours for name in node.names}


@pytest.mark.parametrize(("module", "name"), sorted(imports()))
def test_every_import_exists(module, name):
    assert hasattr(importlib.import_module(module), name)


def test_no_link_between_documents_is_broken():
    pages = [
        "reference/settings.md",
        "reference/commands.md",
        *(f"reference/api/{name}.md" for name in PACKAGES | NAMES),
    ]
    generated, broken = {ROOT / "docs" / page for page in pages}, []
    for page in DOCS:
        text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
        for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text):
            path = (page.parent / target).resolve()
            if "://" not in target and not target.startswith("mailto:") and not (path.exists() or path in generated):
                broken.append(f"{page.relative_to(ROOT)}: {target}")
    assert broken == []


@pytest.mark.parametrize(
    "page", [path for path in DOCS if path.parent.name in ("theory", "decisions")], ids=lambda path: path.stem
)
def test_what_theory_and_decisions_name_exists(page):
    text = page.read_text(encoding="utf-8")
    for name in re.findall(r"`(edgeslam_torch(?:\.\w+)+)`", text):
        assert resolve_name(name)
    for path in re.findall(r"`([\w/]+/[\w/]*(?:\.py)?)`", text):
        assert (ROOT / path).exists() or (ROOT / "edgeslam_torch" / path).exists(), path
