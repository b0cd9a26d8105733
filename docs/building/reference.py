"""Pages of the reference that follow from the code: settings, commands, and the public names of Python."""

import argparse
import dataclasses
import json
import re
from functools import cache
from pathlib import Path

import griffe

from edgeslam_torch.cli import available
from edgeslam_torch.command_line import full_parser
from edgeslam_torch.config import SlamConfig

ROOT = Path(__file__).resolve().parents[2]

PACKAGES = {"slam": "edgeslam_torch", "losses": "edgeslam_torch.losses", "models": "edgeslam_torch.models"} | {
    "train": "edgeslam_torch.train"
}
"""Page: the package whose ``__all__`` it documents."""
NAMES = {
    "drone": (
        "drone.tello.Tello",
        "drone.address.TelloAddress",
        "flying.navigator.Navigator",
        "flying.result.FlightResult",
        "navigation.limits.NavLimits",
    ),
    "eval": ("eval.metrics.run_score.evaluate_run", "eval.metrics.run_score.RunScore", "eval.metrics.align.umeyama"),
    "networks": (
        "types.FrameStatus",
        "frontend.depth_network.open_depth",
        "demo.flight.DemoSettings",
        "demo.flight.record",
    ),
}
"""Page: names of other modules that guides and examples use."""
TITLES = {"drone": "Drone and flight", "eval": "Evaluation", "networks": "Depth networks and simulation"}

UNITS = {
    "m_s_sqrt_s": "m/s/√s",
    "rad_sqrt_s": "rad/√s",
    "m_s": "m/s",
    "deg": "°",
    "rad": "rad",
    "px": "px",
    "m": "m",
    "s": "s",
}
"""Ends of names, longest first, and the unit that they state."""


@cache
def _package() -> griffe.Object:
    """The package as read from its files."""
    return griffe.load("edgeslam_torch", search_paths=[str(ROOT)], submodules=True)


def settings_page() -> str:
    """Every setting of `SlamConfig` with its default, unit and reason.

    Raises:
        ValueError: If one has no reason.
    """
    package, top, sections = _package(), [], []
    for field in dataclasses.fields(SlamConfig):
        value = getattr(SlamConfig(), field.name)
        if not dataclasses.is_dataclass(value):
            top.append(_row(field.name, value, package["config.SlamConfig"]))
            continue
        kind = type(value)
        source = package[f"{kind.__module__}.{kind.__name__}".partition(".")[2]]
        rows = [_row(inner.name, getattr(value, inner.name), source) for inner in dataclasses.fields(kind)]
        sections.append("\n".join([f"## {field.name}\n", f"{_paragraph(source)}\n", _SETTINGS_HEAD, *rows]))
    return "\n\n".join([_SETTINGS_INTRO, "\n".join([_SETTINGS_HEAD, *top]), *sections]) + "\n"


_SETTINGS_HEAD = "| setting | default | what it does, and why |\n|---|---|---|"
_SETTINGS_INTRO = """# Settings

One set of defaults serves all recordings. `edgeslam run SOURCE --set orb.features=600` changes a setting, `--config
FILE.toml` several. `config.toml` in a run's folder holds all settings of that run, and can be passed to `--config`."""


def _row(name: str, value: object, source: griffe.Class) -> str:
    unit = next((f" {unit}" for end, unit in UNITS.items() if name.endswith(f"_{end}")), "")
    shown = f"{value:.4g}" if isinstance(value, float) else json.dumps(value)
    return f"| `{name}` | `{shown}`{unit} | {_paragraph(source[name])} |"


def _paragraph(described: griffe.Object) -> str:
    if described.docstring is None:
        raise ValueError(f"{described.path} has no docstring that says what it does, and why")
    return " ".join(described.docstring.value.replace("``", "`").replace("|", "\\|").split())


def commands_page() -> str:
    """Every command with its options, from the parsers that read them."""
    commands = available()
    parts = ["# Commands", _COMMANDS_INTRO]
    for name, parser in _below(full_parser(commands)).items():
        parts += _command(f"edgeslam {name}", parser, 2)
    return "\n\n".join(parts) + "\n"


_COMMANDS_INTRO = """`edgeslam COMMAND --help` prints the same. Every command takes `--verbose` (debug messages, and
tracebacks of errors) and, where it writes files, `--overwrite`. Exit codes: 0 done, 1 an error that one line on stderr
names, 2 a mistake in the command line, 130 after Ctrl-C."""
_EVERYWHERE = ("--help", "--verbose", "--overwrite")


def _below(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """A parser's commands."""
    return {
        name: inner
        for action in parser._actions
        if isinstance(action, argparse._SubParsersAction)
        for name, inner in action.choices.items()
    }


def _command(title: str, parser: argparse.ArgumentParser, level: int) -> list[str]:
    parts = [f"{'#' * level} {title}", (parser.description or "").strip()]
    rows = [_option(parser, action) for action in parser._actions if _is_shown(action)]
    if rows:
        parts.append("\n".join(["| option | what |", "|---|---|", *rows]))
    if parser.epilog and "examples:" in parser.epilog:
        parts.append(re.sub(r"^  ", "    ", parser.epilog.split("examples:\n")[1], flags=re.MULTILINE))
    for name, inner in _below(parser).items():
        parts += _command(f"{title} {name}", inner, level + 1)
    return [part for part in parts if part]


def _is_shown(action: argparse.Action) -> bool:
    hidden = action.help == argparse.SUPPRESS or isinstance(action, argparse._SubParsersAction)
    return not hidden and not set(action.option_strings) & set(_EVERYWHERE)


def _option(parser: argparse.ArgumentParser, action: argparse.Action) -> str:
    formatter = parser._get_formatter()
    names = formatter._format_action_invocation(action)
    text = " ".join(formatter._expand_help(action).split()) if action.help else ""
    return f"| `{names}` | {_plain(text)} |"


def _plain(text: str) -> str:
    """Help as Markdown: letters with a meaning there are escaped."""
    return re.sub(r"([|*_<>\[\]`])", r"\\\1", text)


def api_pages() -> dict[str, str]:
    """Page of the site: the names that it documents, in Markdown for mkdocstrings."""
    package, found = _package(), {}
    for page, name in PACKAGES.items():
        module = package[name.partition(".")[2]] if "." in name else package
        # A package whose ``__all__`` is computed has its public names in its stub.
        stated = [str(export) for export in module.exports or ()]
        names = stated or sorted(name for name, member in module.members.items() if member.is_alias)
        exported = [module.members[name] for name in names if name != "__version__"]
        paths = [member.target_path if member.is_alias else member.path for member in exported]
        found[page] = _api_page(name, module.docstring.value if module.docstring else "", paths)
    for page, names in NAMES.items():
        found[page] = _api_page(TITLES[page], "", [f"edgeslam_torch.{name}" for name in names], full_path=True)
    return {f"reference/api/{page}.md": text for page, text in found.items()}


def _api_page(title: str, text: str, paths: list[str], full_path: bool = False) -> str:
    options = f"    options:\n      heading_level: 2\n      show_root_full_path: {str(full_path).lower()}"
    blocks = [f"::: {path}\n{options}" for path in paths]
    return "\n\n".join([f"# {title}", text, *blocks]) + "\n"
