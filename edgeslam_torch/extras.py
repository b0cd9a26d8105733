"""Packages that only one corner needs: a missing one is named with the command that installs it."""

from collections.abc import Iterator
from contextlib import contextmanager

from edgeslam_torch.errors import MissingPackageError


@contextmanager
def needs_extra(extra: str, purpose: str) -> Iterator[None]:
    """Imports of optional packages stand inside.

    Args:
        extra: Name in ``[project.optional-dependencies]`` of pyproject.toml.
        purpose: What was asked for, at the start of the message: ``--plots``.

    Raises:
        MissingPackageError: If a package is not installed; one of our own modules that is missing is a bug, and passes.
    """
    try:
        yield
    except ImportError as error:
        name = error.name or str(error)
        if name.startswith("edgeslam_torch"):
            raise
        raise MissingPackageError(f"{purpose} needs {name}: {install_command(extra)}") from error


def install_command(extra: str) -> str:
    """How to install an extra; with the package installed, pip installs the extra's packages only."""
    return f"pip install 'edgeslam-torch[{extra}]'"
