"""The list of commands by groups, and a command's help beside its options."""

import argparse
from collections.abc import Mapping
from typing import Any

from edgeslam_torch.help.examples import EXAMPLES, GROUPS


def described(name: str, text: str) -> dict[str, Any]:
    """Arguments of the parser of a command or of a verb: the first line of its documentation, and examples."""
    lines = EXAMPLES.get(name.split()[0], ())
    examples = "\n".join(f"  {line}" for line in lines if f"{line} ".startswith(f"edgeslam {name} "))
    return {
        "description": text.strip().splitlines()[0],
        "epilog": f"examples:\n{examples}" if examples else None,
        "formatter_class": argparse.RawDescriptionHelpFormatter,
    }


def describe_verbs(name: str, parser: argparse.ArgumentParser) -> None:
    """Give the verbs of a command, if it has any, what its own parser has."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for verb in action._choices_actions:
                for key, value in described(f"{name} {verb.dest}", verb.help or "").items():
                    setattr(action.choices[verb.dest], key, value)


def listing(commands: Mapping[str, tuple[str, str]]) -> str:
    """The commands by groups, each with its line of help."""
    width = max((len(name) for name in commands), default=0)
    grouped = {title: [name for name in names if name in commands] for title, names in GROUPS.items()}
    known = {name for names in grouped.values() for name in names}
    grouped["more"] = [name for name in commands if name not in known]
    return "\n\n".join(
        "\n".join([f" {title}", *(f"  {name:<{width}}  {commands[name][1]}" for name in names)])
        for title, names in grouped.items()
        if names
    )
