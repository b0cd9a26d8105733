"""Addresses of emulated drones in lockstep: ``sim://WORLD[:SEED]``, by the name of a scene or its file."""

from edgeslam_torch.errors import ConfigError, SourceError
from edgeslam_torch.synthetic.sites.build import named_site
from edgeslam_torch.synthetic.sites.site import Site

_SCHEME = "sim://"


def is_simulated(location: str) -> bool:
    """Whether an address is that of an emulated drone in lockstep."""
    return location.startswith(_SCHEME)


def site_of(location: str) -> Site:
    """The world of ``sim://WORLD[:SEED]``; the seed defaults to 0.

    Raises:
        SourceError: If the address is invalid, or the scene's file is wrong.
    """
    name, colon, seed = location.removeprefix(_SCHEME).rstrip("/").partition(":")
    if colon and not (seed.isascii() and seed.isdigit() and len(seed) < 10):
        raise SourceError(f"{location}: seed {seed!r} is not an integer; give {_SCHEME}WORLD[:SEED]")
    try:
        return named_site(name, int(seed or 0))
    except ConfigError as error:
        raise SourceError(f"{location}: {error}") from error
