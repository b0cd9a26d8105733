"""Configuration as nested frozen dataclasses and TOML."""

import dataclasses
import difflib
import json
import math
import tomllib
import types
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from edgeslam_torch.errors import ConfigError
from edgeslam_torch.files.record_files import read_mapping

C = TypeVar("C")


def load_config(default: C, path: Path | None, overrides: Sequence[str] = ()) -> C:
    """``default`` overridden by a TOML file and then by ``section.key=value`` options.

    Args:
        default: A frozen dataclass, with sections that are frozen dataclasses too.
        path: TOML file; None for no file.
        overrides: As for ``--set``.

    Raises:
        ConfigError: If the file cannot be read, a key is unknown, or a value has the wrong type or range; the
            message names the file and the key.
    """
    config = default
    if path is not None:
        config = laid_over(config, read_mapping(path, "TOML", ConfigError), str(path))
    for text in overrides:
        key, equals, value = text.partition("=")
        origin = f"--set {_cut(text)}"
        if not equals or not key.strip():
            raise ConfigError(f"{origin}: write it as section.key=value")
        record: Any = _Text(value.strip())
        for name in reversed(key.strip().split(".")):
            record = {name: record}
        config = laid_over(config, record, origin)
    return config


class _Text(str):
    """A value as the command line has it; its field says what it is."""


def to_toml(config: Any) -> str:
    """A config as TOML that `load_config` reads back to an equal one; None values are omitted.

    Example:
        >>> from dataclasses import dataclass
        >>> @dataclass(frozen=True)
        ... class Example:
        ...     rate_hz: float = 30.0
        ...     name: str = "left"
        >>> print(to_toml(Example()), end="")
        rate_hz = 30.0
        name = "left"
    """
    lines: list[str] = []
    _write_section(config, "", lines)
    return "\n".join(lines) + "\n"


def keys_of(config: Any, prefix: str = "") -> list[str]:
    """Every ``section.key`` that can be set."""
    keys: list[str] = []
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        name = prefix + field.name
        keys += keys_of(value, f"{name}.") if dataclasses.is_dataclass(value) else [name]
    return keys


def laid_over(config: C, record: Mapping[str, Any], origin: str, prefix: str = "") -> C:
    """``config`` overridden by a parsed TOML or JSON table.

    Args:
        config: A frozen dataclass.
        record: Its keys and values.
        origin: Where they come from, for messages.
        prefix: Of the keys in messages.

    Raises:
        ConfigError: If a key is unknown, or a value has the wrong type or range.
    """
    hints = typing.get_type_hints(type(config))
    changes: dict[str, Any] = {}
    for name, value in record.items():
        key = prefix + name
        if name not in hints:
            while isinstance(value, dict) and len(value) == 1:
                (name, value), *_ = value.items()
                key = f"{key}.{name}"
            raise ConfigError(f"{origin}: {_unknown(key, keys_of(config, prefix))}")
        current = getattr(config, name)
        if dataclasses.is_dataclass(current):
            if not isinstance(value, dict):
                inside = ", ".join(field.name for field in dataclasses.fields(current))
                raise ConfigError(f"{origin}: {key} is a section; its keys are {inside}")
            changes[name] = laid_over(current, value, origin, f"{key}.")
        else:
            parsed = _parsed(value, hints[name]) if isinstance(value, _Text) else value
            changes[name] = _checked(parsed, hints[name], key, origin)
    return _replaced(config, changes, origin, prefix)


def _replaced(config: C, changes: dict[str, Any], origin: str, prefix: str) -> C:
    if not changes:
        return config
    try:
        return dataclasses.replace(config, **changes)  # type: ignore[type-var]
    except (ValueError, TypeError) as error:  # ranges, from __post_init__
        section = f"[{prefix.rstrip('.')}] " if prefix else ""
        raise ConfigError(f"{origin}: {section}{error}") from error


def _parsed(text: str, hint: Any) -> Any:
    """A value from the command line: TOML, or a bare word for strings."""
    if str in _options(hint) or any(isinstance(option, str) for option in _options(hint)):
        quoted = len(text) >= 2 and text[0] == text[-1] and text[0] in "\"'"
        return str(text[1:-1] if quoted else text)
    if type(None) in _options(hint) and text.lower() in ("none", "null", ""):
        return None
    low = text.lower()
    candidate = low if low in ("true", "false") else text
    try:
        return tomllib.loads(f"value = {candidate}")["value"]
    except (ValueError, RecursionError):
        return str(text)


def _checked(value: Any, hint: Any, key: str, origin: str) -> Any:
    """The value converted to the field's type."""
    for option in _options(hint):
        ok, result = _as(value, option)
        if ok:
            return result
    raise ConfigError(f"{origin}: {key} must be {_describe(hint)}, got {_cut(repr(value))}")


def _as(value: Any, option: Any) -> tuple[bool, Any]:
    if option is type(None):
        return value is None, None
    if option is float:
        return isinstance(value, (int, float)) and not isinstance(value, bool), _float(value)
    if option in (int, bool, str):
        return type(value) is option, value
    if option is Path:
        return isinstance(value, str), Path(value) if isinstance(value, str) else None
    if typing.get_origin(option) is tuple:
        return _as_tuple(value, typing.get_args(option))
    return type(value) is type(option) and value == option, value  # one of a Literal's values


def _as_tuple(value: Any, hints: tuple[Any, ...]) -> tuple[bool, Any]:
    if not isinstance(value, (list, tuple)):
        return False, None
    if len(hints) == 2 and hints[1] is Ellipsis:
        hints = (hints[0],) * len(value)
    if len(hints) != len(value):
        return False, None
    items = []
    for item, hint in zip(value, hints, strict=True):
        fits = [result for ok, result in (_as(item, option) for option in _options(hint)) if ok]
        if not fits:
            return False, None
        items.append(fits[0])
    return True, tuple(items)


def _float(value: Any) -> float:
    try:
        return float(value) if isinstance(value, (int, float)) else math.nan
    except OverflowError:
        return math.inf


def _cut(text: str) -> str:
    return text if len(text) <= 80 else f"{text[:80]}..."


def _options(hint: Any) -> tuple[Any, ...]:
    """Accepted types or values: members of a union, values of a Literal, or the type itself."""
    origin = typing.get_origin(hint)
    if origin in (typing.Union, types.UnionType):
        return tuple(option for member in typing.get_args(hint) for option in _options(member))
    if origin is typing.Literal:
        return typing.get_args(hint)
    return (hint,)


def _describe(hint: Any) -> str:
    names = {
        int: "an integer",
        float: "a number",
        bool: "true or false",
        str: "text",
        type(None): "none",
        Path: "a path",
    }
    words = []
    for option in _options(hint):
        if typing.get_origin(option) is tuple:
            arguments = typing.get_args(option)
            word = "a list" if Ellipsis in arguments else f"a list of {len(arguments)}"
        else:
            word = names.get(option, repr(option)) if isinstance(option, type) else repr(option)
        words.append(word)
    return " or ".join(words)


def _unknown(key: str, known: Sequence[str]) -> str:
    close = difflib.get_close_matches(key, known, n=1, cutoff=0.6)
    if not close:  # the right name in the wrong section
        close = [candidate for candidate in known if candidate.split(".")[-1] == key.split(".")[-1]][:1]
    hint = f"; did you mean {close[0]!r}?" if close else f"; known: {', '.join(known[:8])}, ..."
    return f"unknown key {key!r}{hint}"


def _write_section(config: Any, prefix: str, lines: list[str]) -> None:
    sections = []
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            sections.append((field.name, value))
        elif value is not None:
            lines.append(f"{field.name} = {_toml_value(value)}")
    for name, section in sections:
        lines += ["", f"[{prefix}{name}]"]
        _write_section(section, f"{prefix}{name}.", lines)


def _toml_value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(int(value))
    if isinstance(value, float):
        return repr(value) if math.isfinite(value) else str(value)  # inf and nan are TOML too
    if isinstance(value, (str, Path)):
        return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, (tuple, list)):
        return "[" + ", ".join(_toml_value(item) for item in value) + "]"
    raise TypeError(f"cannot write {type(value).__name__} to TOML")
