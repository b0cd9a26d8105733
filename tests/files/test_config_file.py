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
        ("inner.rate_hz=2", "inner.rate_hz", 2.0),
        ("inner.on=False", "inner.on", False),
        ("inner.name=plain words", "inner.name", "plain words"),
        ("inner.name='5'", "inner.name", "5"),
        ("inner.kind=body", "inner.kind", "body"),
        ("inner.limit=none", "inner.limit", None),
        ("inner.span=[1, 2.5]", "inner.span", (1.0, 2.5)),
        (" inner.count = 8 ", "inner.count", 8),
    ],
)
def test_set_option(option, path, value):
    found = attrgetter(path)(load_config(Outer(), None, [option]))
    assert found == value and type(found) is type(value)


@pytest.mark.parametrize("option", ["inner.cuont=1", "count=1", "inne.count=1", "[inner]\ncunt = 1"])
def test_a_mistyped_key_is_answered_with_the_one_that_is_meant(tmp_path, option):
    (tmp_path / "c.toml").write_text(option)
    with pytest.raises(ConfigError, match="did you mean 'inner.count'"):
        load_config(Outer(), *((tmp_path / "c.toml", []) if "\n" in option else (None, [option])))


@pytest.mark.parametrize(
    "option",
    ["inner=1", "seed.x=1", "inner.count=2.5", "inner.count=true", "inner.count=many", "inner.on=1", "inner.kind=sea",
     "inner.span=[1]", "inner.count=0", "inner.count", "=3"],
)  # fmt: skip
def test_a_wrong_option_is_refused(option):
    with pytest.raises(ConfigError, match="--set "):
        load_config(Outer(), None, [option])


@pytest.mark.parametrize("text", ["[inner]\ncount = 0", "inner = 3", "[iner]\ncount = 1", "seed = ", 'seed = "1"'])
def test_a_wrong_file_is_refused_by_name_and_options_win_over_a_right_one(tmp_path, text):
    (tmp_path / "c.toml").write_text(text)
    with pytest.raises(ConfigError, match=r"c\.toml: "):
        load_config(Outer(), tmp_path / "c.toml")
    (tmp_path / "c.toml").write_text("seed = 1\n[inner]\ncount = 5\n")
    config = load_config(Outer(), tmp_path / "c.toml", ["seed=2"])
    assert (config.seed, config.inner.count) == (2, 5)


FLOATS = [key for key in keys_of(SlamConfig()) if isinstance(attrgetter(key)(SlamConfig()), float)]


@pytest.mark.parametrize("key", [*FLOATS, "fusion.delay_s", "fusion.delay_range_s"])
def test_no_number_may_be_infinite_or_none(key):
    for value in ("nan", "inf", "-inf", "1e999"):
        with pytest.raises(ConfigError, match=key.split(".")[-1]):
            load_config(SlamConfig(), None, [f"{key}=[{value}, 1.0]" if key.endswith("range_s") else f"{key}={value}"])


def test_numbers_are_checked_in_code_too():
    with pytest.raises(ValueError, match="edges.canny_high must be finite, got inf"):
        SlamConfig(edges=EdgeConfig(canny_high=math.inf))
    with pytest.raises(ValueError, match="edges.max_pixels must be within 32 bits"):
        SlamConfig(edges=EdgeConfig(max_pixels=2**31))
