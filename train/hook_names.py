"""Hooks of ``--hook MODULE:NAME`` or ``FILE.py:NAME``."""

import importlib
import importlib.util
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

from edgeslam_torch.errors import ConfigError
from edgeslam_torch.train.recipe import Hooks


def named_hooks(names: Sequence[str]) -> list[Hooks]:
    """The hooks that users name: subclasses of `Hooks`, made without arguments, or instances.

    Modules are looked for in the current folder, too. They are run: name only code that you trust.

    Raises:
        ConfigError: If there is no such thing, or it is no hook; one line that says which.
    """
    return [_made(name) for name in names]


def _made(name: str) -> Hooks:
    where, colon, what = name.rpartition(":")
    if not (colon and where and what.isidentifier()):
        raise ConfigError(f"--hook {name}: write MODULE:NAME or FILE.py:NAME")
    module = _loaded(name, where)
    try:
        found = getattr(module, what)
        hook = found() if isinstance(found, type) and issubclass(found, Hooks) else found
    except AttributeError as error:
        raise ConfigError(f"--hook {name}: {where} has no {what}") from error
    except Exception as error:
        raise ConfigError(
            f"--hook {name}: cannot be made without arguments ({_words(error)}); name an instance instead"
        ) from error
    if not isinstance(hook, Hooks):
        raise ConfigError(f"--hook {name}: is no edgeslam_torch.train.Hooks")
    return hook


def _loaded(name: str, where: str) -> ModuleType:
    path = Path(where)
    if where.endswith(".py") and not path.is_file():
        raise ConfigError(f"--hook {name}: {where}: no such file")
    try:
        if not where.endswith(".py"):
            if os.getcwd() not in sys.path:
                sys.path.insert(0, os.getcwd())  # as python -m does
            return importlib.import_module(where)
        spec = importlib.util.spec_from_file_location(path.stem, path)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules.setdefault(path.stem, module)  # dataclasses look their module up
        spec.loader.exec_module(module)
        return module
    except Exception as error:
        raise ConfigError(f"--hook {name}: {where} cannot be imported ({_words(error)})") from error


def _words(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:160]}"
