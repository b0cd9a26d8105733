"""Whatever lies in a file of settings or results ends in one line."""

import pytest

from edgeslam_torch.errors import ConfigError
from edgeslam_torch.files.record_files import read_mapping


def test_a_record_is_read(tmp_path):
    (tmp_path / "a").write_text('{"x": [1, 2]}')
    (tmp_path / "b").write_text("x = [1, 2]")
    assert read_mapping(tmp_path / "a", "JSON", ConfigError) == read_mapping(tmp_path / "b", "TOML", ConfigError)


@pytest.mark.parametrize("kind", ["JSON", "TOML"])
@pytest.mark.parametrize("content", [b'x = "', b"\xff\xfe", b"9" * 5000, b"x = " + b"[" * 100_000])
def test_what_is_no_record_is_refused_by_name(tmp_path, kind, content):
    (tmp_path / "settings").write_bytes(content)
    with pytest.raises(ConfigError, match=f"^{tmp_path / 'settings'}: not valid") as caught:
        read_mapping(tmp_path / "settings", kind, ConfigError)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("line", ["x" + ".x" * 100_000 + " = 1", "[x" + ".x" * 50_000 + "]", "x = {y" + ".y" * 50_000])
def test_toml_keys_of_endless_parts_are_refused_at_once(tmp_path, line):
    (tmp_path / "settings").write_text(f"a = 1\n{line}\n")
    with pytest.raises(ConfigError):
        read_mapping(tmp_path / "settings", "TOML", ConfigError)
