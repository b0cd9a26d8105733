import math
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Literal

import pytest

from edgeslam_torch.config import EdgeConfig, SlamConfig
from edgeslam_torch.errors import ConfigError
from edgeslam_torch.files.config_file import keys_of, load_config, to_toml


@dataclass(frozen=True, slots=True)
class Inner:
    count: int = 3
    rate_hz: float = 30.0
    name: str = 'a "quoted" \\ name'
    on: bool = True
    kind: Literal["world", "body"] = "world"
    limit: float | None = None
    span: tuple[float, float] = (0.5, math.inf)
    many: tuple[int, ...] = (1, 2)

    def __post_init__(self):
        if self.count < 1:
            raise ValueError(f"count must be at least 1, got {self.count}")


@dataclass(frozen=True, slots=True)
class Outer:
    seed: int = 0
    inner: Inner = field(default_factory=Inner)


def test_round_trip(tmp_path):
    config = Outer(7, Inner(9, 1e-7, "tab\t line\n ü", False, "body", 2.0, (0.1, 0.2), ()))
    (tmp_path / "c.toml").write_text(to_toml(config), encoding="utf-8")
    assert load_config(Outer(), tmp_path / "c.toml") == config


@pytest.mark.parametrize(
    ("option", "path", "value"),
    [
        ("seed=4", "seed", 4),
        ("inner.rate_hz=2", "inner.rate_hz", 2.0),
        ("inner.rate_hz=1e-3", "inner.rate_hz", 0.001),
        ("inner.on=False", "inner.on", False),
        ("inner.name=plain words", "inner.name", "plain words"),
        ("inner.name='5'", "inner.name", "5"),
        ("inner.kind=body", "inner.kind", "body"),
        ("inner.limit=3", "inner.limit", 3.0),
        ("inner.limit=none", "inner.limit", None),
        ("inner.span=[1, 2.5]", "inner.span", (1.0, 2.5)),
        ("inner.many=[5]", "inner.many", (5,)),
        (" inner.count = 8 ", "inner.count", 8),
    ],
)
def test_set_option(option, path, value):
    config = load_config(Outer(), None, [option])
    for name in path.split("."):
        config = getattr(config, name)
    assert config == value
    assert type(config) is type(value)


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("inner.cuont=1", "did you mean 'inner.count'"),
        ("count=1", "did you mean 'inner.count'"),
        ("inne.count=1", "did you mean 'inner.count'"),
        ("inner=1", "is a section"),
        ("seed.x=1", "is a value"),
        ("inner.count=2.5", "must be an integer, got 2.5"),
        ("inner.count=true", "must be an integer"),
        ("inner.count=many", "must be an integer, got 'many'"),
        ("inner.on=1", "must be true or false"),
        ("inner.kind=sea", "must be 'world' or 'body'"),
        ("inner.span=[1]", "a list of 2"),
        ("inner.count=0", "count must be at least 1"),
        ("inner.count", "write it as section.key=value"),
        ("=3", "write it as section.key=value"),
    ],
)
def test_wrong_option_is_explained(option, words):
    with pytest.raises(ConfigError, match=f"--set .*{words}"):
        load_config(Outer(), None, [option])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[inner]\ncount = 0", r"c.toml: \[inner\] count must be"),
        ("[inner]\ncunt = 1", "c.toml: unknown key 'inner.cunt'; did you mean 'inner.count'"),
        ("inner = 3", "c.toml: inner is a section"),
        ("[iner]\ncount = 1", "c.toml: unknown key 'iner'"),
        ("seed = ", "c.toml: not valid TOML"),
        ('seed = "1"', "c.toml: seed must be an integer"),
    ],
)
def test_wrong_file_is_explained(tmp_path, text, words):
    (tmp_path / "c.toml").write_text(text)
    with pytest.raises(ConfigError, match=words):
        load_config(Outer(), tmp_path / "c.toml")


def test_options_win_over_the_file(tmp_path):
    (tmp_path / "c.toml").write_text("seed = 1\n[inner]\ncount = 5\n")
    config = load_config(Outer(), tmp_path / "c.toml", ["seed=2"])
    assert (config.seed, config.inner.count) == (2, 5)


FLOATS = [key for key in keys_of(SlamConfig()) if isinstance(attrgetter(key)(SlamConfig()), float)]


@pytest.mark.parametrize("key", [*FLOATS, "fusion.delay_s", "fusion.delay_range_s"])
def test_no_number_may_be_infinite_or_none(key):
    for value in ("nan", "inf", "-inf", "1e999"):
        with pytest.raises(ConfigError, match=key.split(".")[-1]):
            load_config(SlamConfig(), None, [f"{key}=[{value}, 1.0]" if key.endswith("range_s") else f"{key}={value}"])


@pytest.mark.parametrize("option", ["orb.levels=21", "orb.features=2000000000"])
def test_what_costs_gigabytes_or_hours_is_refused(option):
    with pytest.raises(ConfigError, match="must be at most"):
        load_config(SlamConfig(), None, [option])


def test_numbers_are_checked_in_code_too():
    with pytest.raises(ValueError, match="edges.canny_high must be finite, got inf"):
        SlamConfig(edges=EdgeConfig(canny_high=math.inf))
    with pytest.raises(ValueError, match="edges.max_pixels must be within 32 bits"):
        SlamConfig(edges=EdgeConfig(max_pixels=2**31))
