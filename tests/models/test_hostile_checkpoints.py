"""Torch checkpoints made to cost time or memory, or to run something: refused in a line, at once, in little memory.

The programs below are pickles written instruction by instruction, named after what they do to Python's own unpickler
and to whoever believes their tensors. All are read in one process whose memory is limited.
"""

import math
import multiprocessing
import resource
import struct
import sys
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.models.convert import convert_upstream, read_upstream
from edgeslam_torch.models.fastdepth import FastDepth, Variant

MAGIC = b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19."
PROTOCOL = b"\x80\x02M\xe9\x03."
SYSTEM = b"\x80\x02}."
SECONDS = 60
"""Of processor time for all files together, which take a tenth of it: the system ends what reads on."""
MEMORY = 400 << 20
"""More than the process has already."""


def text(value):
    return b"X" + struct.pack("<I", len(value)) + value.encode()


def number(value):
    raw = value.to_bytes(9, "little", signed=True)
    return b"\x8a\x09" + raw


def storage(count, key="0", kind=b"FloatStorage"):
    return b"(" + text("storage") + b"ctorch\n" + kind + b"\n" + text(key) + text("cpu") + number(count) + b"NtQ"


def shape(*sizes):
    return b"(" + b"".join(map(number, sizes)) + b"t"


def tensor(count, size, stride, offset=0):
    arguments = storage(count) + number(offset) + shape(*size) + shape(*stride) + b"\x89}"
    return b"ctorch._utils\n_rebuild_tensor_v2\n(" + arguments + b"tR"


def table(name, value):
    return b"}" + text(name) + value + b"s"


def legacy(program, blocks=None):
    """A file of torch < 1.6 around one program; ``blocks`` are the storages' bytes after their count."""
    keys = b"]" + b"".join(text(k) + b"a" for k in blocks or {})
    return (
        MAGIC
        + PROTOCOL
        + SYSTEM
        + b"\x80\x02"
        + program
        + b"."
        + b"\x80\x02"
        + keys
        + b"."
        + b"".join((blocks or {}).values())
    )


def block(count, data):
    return struct.pack("<Q", count) + data


NESTED = b"K\x01\x85" + b"2\x86" * 60
"""A tuple of the tuple before it, twice: 2^60 leaves for whoever hashes, compares or prints it."""
LIST_OF_PAIRS = b"](" + b"K\x01K\x02\x86" * 30_000 + b"eq\x00"

PROGRAMS = {
    # Allocations claimed by a few bytes.
    "storage of 12 GB in 4 bytes": legacy(
        table("a", tensor(3 << 30, (3 << 30,), (1,))), {"0": block(3 << 30, bytes(4))}
    ),
    "tensor of 40 GB in 4 bytes": legacy(table("a", tensor(1, (100_000, 100_000), (0, 0))), {"0": block(1, bytes(4))}),
    "tensor beyond its storage": legacy(table("a", tensor(1, (1,), (1,), 1 << 39)), {"0": block(1, bytes(4))}),
    "tensor of a negative size": legacy(table("a", tensor(1, (-1,), (1,))), {"0": block(1, bytes(4))}),
    "count of 2^63": legacy(table("a", tensor(1, (1,), (1,))), {"0": block(1 << 63, bytes(4))}),
    "memo of 32 GB": legacy(b"Nr\xff\xff\xff\xff"),
    "text of 4 GB": legacy(b"X\xff\xff\xff\xff"),
    "bytes of 16 EB": legacy(b"\x8e" + b"\xff" * 8),
    "number of 4 GB": legacy(b"\x8b\xff\xff\xff\x7f"),
    # Time.
    "2 million instructions": legacy(b"N0" * 1_100_000),
    "400 000 lists in one another": legacy(b"]" * 400_000 + b"a" * 399_999),
    "a key that takes for ever to hash": legacy(b"}" + NESTED + b"Ns"),
    "keys that take for ever to compare": legacy(b"}(" + NESTED + b"N" + NESTED + b"Nu"),
    "a storage's key that takes for ever to print": legacy(
        b"(" + text("storage") + b"ctorch\nFloatStorage\n" + NESTED + text("cpu") + b"K\x01NtQ"
    ),
    "a name that takes for ever to print": legacy(
        b"}(" + text("metadata") + NESTED + text("state_dict") + table("a", NESTED) + b"u"
    ),
    "a copy of a long list again and again": legacy(
        LIST_OF_PAIRS + b"ccollections\nOrderedDict\nq\x01" + b"h\x01h\x00\x85R0" * 30_000
    ),
    # Nonsense.
    "nothing on the stack": legacy(b"0"),
    "a call of a number": legacy(b"K\x01)R"),
    "a call without arguments": legacy(b"ctorch._utils\n_rebuild_tensor_v2\n)R"),
    "a tensor of nothing": legacy(table("a", b"ctorch._utils\n_rebuild_tensor_v2\n(NNNNtR"), {}),
    "a text instruction": legacy(b"I1\n"),
    "bytes of nobody's": legacy(b"}", {"7": block(1, bytes(4))}),
    "keys that are no list": MAGIC + PROTOCOL + SYSTEM + b"\x80\x02}." + b"\x80\x02" + NESTED + b".",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("hostile")
    for name, content in PROGRAMS.items():
        (folder / f"{name}.pth").write_bytes(content)
    for name, content in zips(folder):
        (folder / f"{name}.pth").write_bytes(content)
    for zipped in (True, False):
        torch.save(
            {"model": shared_modules()},
            folder / f"modules in one another {zipped}.pth",
            _use_new_zipfile_serialization=zipped,
        )
    return folder


def shared_modules():
    """Each level holds the one below it ten times: 10^14 names."""
    module = nn.Conv2d(1, 1, 1)
    for _ in range(14):
        module = nn.Sequential(*[module] * 10)
    return module


def zips(folder):
    path = folder / "z"

    def written(parts, compression=zipfile.ZIP_STORED):
        with zipfile.ZipFile(path, "w", compression) as archive:
            for name, data in parts.items():
                archive.writestr(f"a/{name}", data)
        content = path.read_bytes()
        path.unlink()
        return content

    program = b"\x80\x02" + table("a", tensor(1 << 28, (1 << 28,), (1,))) + b"."
    yield "zip, zeros", written({"data.pkl": program, "data/0": bytes(1 << 25)}, zipfile.ZIP_DEFLATED)
    yield "zip, bytes missing", written({"data.pkl": program})
    yield "zip, storage of a gigabyte in 4 bytes", written({"data.pkl": program, "data/0": bytes(4)})
    yield "zip, no pickle", written({"data/0": bytes(4)})
    yield "zip, 40 000 parts", written({str(k): b"" for k in range(40_000)} | {"data.pkl": program})
    whole = written({"data.pkl": program, "data/0": bytes(4)})
    yield "zip, cut", whole[:-10]
    larger = bytearray(whole)
    at = whole.rindex(b"PK\x01\x02")
    larger[at + 20 : at + 28] = struct.pack("<II", 1 << 31, 1 << 31)
    yield "zip, a part larger than the file", bytes(larger)
    elsewhere = bytearray(whole)
    elsewhere[at + 42 : at + 46] = struct.pack("<I", 1 << 30)
    yield "zip, a part outside the file", bytes(elsewhere)


def read_all(folder, sender):
    """How each file ends: its name and the refusal; they may use what is left of memory and processor time."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY,) * 2)
    resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(time.process_time()) + SECONDS,) * 2)
    rows = []
    for path in sorted(folder.glob("*.pth")):
        try:
            convert_upstream(path, path.with_suffix(".safetensors"))
            said = "ACCEPTED"
        except WeightsError as error:
            said = str(error).removeprefix(str(path))
        rows.append((path.stem, said))
    sender.send(rows)


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_hostile_files_end_at_once_in_a_line_and_in_little_memory(folder):
    receiver, sender = multiprocessing.Pipe(duplex=False)
    child = multiprocessing.get_context("fork").Process(target=read_all, args=(folder, sender))
    child.start()
    sender.close()
    rows = receiver.recv()
    child.join()
    assert child.exitcode == 0
    assert len(rows) == len(list(folder.glob("*.pth"))) > len(PROGRAMS)
    for name, said in rows:
        assert said.startswith(": "), (name, said)
        assert "\n" not in said
        assert len(said) < 250, (name, said)
    assert not list(folder.glob("*.safetensors"))
    said_of = dict(rows)
    assert "more than 5000 modules" in said_of["modules in one another True"]
    assert "larger than 2 MiB" in said_of["2 million instructions"]


def test_strided_and_shared_tensors_are_those_that_torch_reads(tmp_path):
    """Transposed memory and two parameters in one block, as fused optimisers leave them."""
    torch.manual_seed(0)
    state = FastDepth(Variant.PRUNED).state_dict()
    weight = state["conv0.0.weight"]
    state["conv0.0.weight"] = weight.to(memory_format=torch.channels_last)
    flat = torch.randn(32)
    state["conv0.1.weight"], state["conv0.1.bias"] = flat[:16], flat[16:]
    for zipped in (True, False):
        torch.save(state, tmp_path / "w.pth", _use_new_zipfile_serialization=zipped)
        read, _ = read_upstream(tmp_path / "w.pth")
        for name, tensor in torch.load(tmp_path / "w.pth", weights_only=True).items():
            np.testing.assert_array_equal(read[name], tensor.numpy())


def test_a_module_inside_itself_ends(tmp_path):
    itself = b"ctorch.nn.modules.container\nSequential\n)\x81q\x00" + table("_modules", table("0", b"h\x00")) + b"b"
    (tmp_path / "w.pth").write_bytes(legacy(itself))
    with pytest.raises(WeightsError, match="more than 5000 modules"):
        read_upstream(tmp_path / "w.pth")
