"""JSON, TOML and YAML files, read so that whatever lies in one ends in a single line."""

import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from edgeslam_torch.errors import EdgeSlamError

MAX_BYTES = {"JSON": 64 << 20, "TOML": 256 << 10, "YAML": 1 << 20}
"""Of one file; a benchmark of a thousand runs takes 2 MB, settings and cameras a few kB."""
MAX_DOTS = 300
"""In a line of TOML; the time for a dotted key grows with the square of its parts."""


def plain_yaml(text: str) -> Any:
    """YAML without aliases, of which a few lines can make gigabytes, and with OpenCV's first line.

    Raises:
        ValueError: If it is malformed.
        RecursionError: If it is nested too deeply.
    """
    import yaml

    class Loader(yaml.SafeLoader):
        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                raise ValueError("aliases are not read")
            return super().compose_node(parent, index)

    try:
        return yaml.load(text.replace("%YAML:1.0", ""), Loader)
    except yaml.YAMLError as error:
        raise ValueError(" ".join(str(error).split())) from error


def _toml(text: str) -> dict[str, Any]:
    if any(line.count(".") > MAX_DOTS for line in text.split("\n")):
        raise RecursionError
    return tomllib.loads(text)


_PARSERS: dict[str, Callable[[str], Any]] = {"JSON": json.loads, "TOML": _toml, "YAML": plain_yaml}


def read_mapping(path: Path, kind: str, error: type[EdgeSlamError]) -> dict[str, Any]:
    """What a file of one record holds.

    Args:
        path: The file.
        kind: ``JSON``, ``TOML`` or ``YAML``.
        error: What to raise.

    Raises:
        EdgeSlamError: ``error``, with the file's name, if it cannot be read, is malformed, or holds no record.
    """
    try:
        size = path.stat().st_size
        if size > MAX_BYTES[kind]:
            raise error(f"{path}: not {kind} of ours ({size / 1e6:.1f} MB)")
        record = _PARSERS[kind](path.read_text(encoding="utf-8"))
    except OSError as reason:
        raise error(f"{path}: {reason.strerror or reason}") from reason
    except RecursionError as reason:
        raise error(f"{path}: not valid {kind} (nested too deeply)") from reason
    except ValueError as reason:  # malformed, not UTF-8, a number of thousands of digits
        raise error(f"{path}: not valid {kind} ({reason})") from reason
    if not isinstance(record, dict):
        raise error(f"{path}: not a {kind} object")
    return record
