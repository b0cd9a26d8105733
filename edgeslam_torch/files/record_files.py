"""JSON, TOML and YAML files, read safely: any content gives a record or a one-line error."""

import json
import re
import tomllib
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

from edgeslam_torch.errors import EdgeSlamError
from edgeslam_torch.files.plain import read_bounded

MAX_BYTES = {"JSON": 64 << 20, "TOML": 256 << 10, "YAML": 1 << 20}
"""Maximum file size; a benchmark of a thousand runs takes 2 MB, settings and cameras a few kB."""
MAX_DOTS = 300
"""Maximum number of dots in a line of TOML; parsing a dotted key takes quadratic time."""


def plain_yaml(text: str) -> Any:
    """Parse the first document of a YAML file without aliases, which can expand to gigabytes.

    OpenCV's header line is accepted, tags such as ``!!opencv-matrix`` are ignored.

    Raises:
        ValueError: If it is malformed, or a key occurs twice.
        RecursionError: If it is nested too deeply.
    """
    import yaml

    class Loader(yaml.SafeLoader):
        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                raise ValueError("aliases are not read")
            return super().compose_node(parent, index)

        def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
            names = [key.value for key, _ in node.value if isinstance(key.value, str)]
            if len(set(names)) < len(names):
                raise ValueError(f"{next(name for name in names if names.count(name) > 1)[:40]!r} occurs twice")
            return super().construct_mapping(node, deep)

        def construct_tagged(self, _: str, node: Any) -> Any:
            if isinstance(node, yaml.MappingNode):
                return self.construct_mapping(node, deep=True)
            return self.construct_sequence(node, deep=True) if isinstance(node, yaml.SequenceNode) else node.value

    Loader.add_multi_constructor("", Loader.construct_tagged)
    try:
        return next(iter(yaml.load_all(re.sub(r"\A\s*%YAML.*", "", text), Loader)), None)
    except yaml.YAMLError as error:
        raise ValueError(" ".join(str(error).split())) from error


def _toml(text: str) -> dict[str, Any]:
    if any(line.count(".") > MAX_DOTS for line in text.split("\n")):
        raise RecursionError
    return tomllib.loads(text)


_PARSERS: dict[str, Callable[[str], Any]] = {"JSON": json.loads, "TOML": _toml, "YAML": plain_yaml}


def read_mapping(path: Path, kind: str, error: type[EdgeSlamError]) -> dict[str, Any]:
    """Read a file that contains one record.

    Args:
        path: The file.
        kind: ``JSON``, ``TOML`` or ``YAML``.
        error: Exception class to raise.

    Raises:
        EdgeSlamError: ``error``, with the file's name, if it cannot be read, is malformed, or holds no record.
    """
    data = read_bounded(path, MAX_BYTES[kind], error, f"{kind} of ours")
    try:
        record = _PARSERS[kind](data.decode("utf-8"))
    except RecursionError as reason:
        raise error(f"{path}: not valid {kind} (nested too deeply)") from reason
    except ValueError as reason:  # malformed, not UTF-8, or a number with thousands of digits
        raise error(f"{path}: not valid {kind} ({reason})") from reason
    if not isinstance(record, dict):
        raise error(f"{path}: not a {kind} object")
    return record


def is_record(path: Path, keys: Collection[str]) -> bool:
    """Whether a file is a JSON object with these keys: what tells a result of ours from a file of others."""
    try:
        return read_mapping(path, "JSON", EdgeSlamError).keys() >= set(keys)
    except EdgeSlamError:
        return False


def recording_of(run: Path, summary: Mapping[str, Any]) -> Path | None:
    """What a run read, by its summary, which names it relative to the run's folder; None if it does not say."""
    source = summary.get("source")
    name = source.get("path") if isinstance(source, dict) else source
    return run / name if isinstance(name, str) and name else None
