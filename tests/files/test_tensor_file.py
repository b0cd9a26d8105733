"""Named arrays in a safetensors file: what is written is read, what is damaged is refused."""

import json

import numpy as np
import pytest
import safetensors.numpy

from edgeslam_torch.files.tensor_file import KINDS, Damaged, read_entries, write_tensors

SIZES = {kind: dtype.itemsize for kind, dtype in KINDS.items()}
ARRAYS = {
    "a": np.arange(6, dtype="<f4").reshape(2, 3),
    "b": np.array([], dtype="<i8"),
    "c": np.array([[1, 2]], dtype="u1"),
}


def raw(header, data=b""):
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + data


def read(path):
    with path.open("rb") as file:
        remarks, entries = read_entries(file, SIZES)
        return remarks, {name: entry.array() for name, entry in entries.items()}


def test_what_is_written_is_read_also_by_others_unless_it_is_cut_off(tmp_path):
    write_tensors(tmp_path / "x", {"key": "words"}, ARRAYS)
    remarks, arrays = read(tmp_path / "x")
    assert remarks == {"key": "words"} and list(arrays) == list(ARRAYS)
    by_others = safetensors.numpy.load_file(tmp_path / "x")
    for name, array in ARRAYS.items():
        for found in (arrays[name], by_others[name]):
            np.testing.assert_array_equal(found, array)
            assert found.dtype == array.dtype
    whole = (tmp_path / "x").read_bytes()
    for length in [*range(0, len(whole), 7), len(whole) - 1]:
        (tmp_path / "x").write_bytes(whole[:length])
        with pytest.raises(Damaged):
            read(tmp_path / "x")


def tensor(data, dtype="F32", shape=(1,), offsets=(0, 4), names="a"):
    return raw({name: {"dtype": dtype, "shape": list(shape), "data_offsets": list(offsets)} for name in names}, data)


@pytest.mark.parametrize(
    "content",
    [
        b"\x80\x04pickle",
        raw(b"{"),
        raw([]),
        raw(b"\xff\xfe"),
        raw({"a": []}),
        raw(b"[" * 100_000),
        tensor(bytes(8), offsets=(0,)),
        tensor(bytes(8), dtype=["F32"]),
        tensor(bytes(8), dtype="O", offsets=(0, 8)),
        tensor(bytes(8), shape=(1.0,)),
        tensor(bytes(8), shape=("x",)),
        tensor(bytes(8), offsets=(0, 8)),
        tensor(bytes(7), shape=(2,), offsets=(0, 8)),
        tensor(bytes(8), shape=(-1,), offsets=(0, -4)),
        tensor(bytes(8), shape=(1 << 62,), offsets=(0, 1 << 64)),
        tensor(bytes(8), dtype="U8", shape=(8,), offsets=(0, 8), names="ab"),
        raw(b'{"a": {"dtype": "F32", "shape": [1], "data_offsets": [0, 1e999]}}', bytes(8)),
        *(length.to_bytes(8, "little") + b'{"a": 1}' for length in (0, (1 << 20) + 1, (1 << 64) - 1)),
    ],
)
def test_a_hostile_file_is_refused(tmp_path, content):
    (tmp_path / "x").write_bytes(content)
    with pytest.raises(Damaged):
        read(tmp_path / "x")
