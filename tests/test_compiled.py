"""Compiled loops: as the Python function, from a cache that may be missing, damaged, stale or somebody else's."""

import ast
import importlib.util
import os
import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from edgeslam_torch import compiled as module
from edgeslam_torch.compiled import build, cache, machine_code
from edgeslam_torch.compiled.signature import parsed
from edgeslam_torch.files.user_cache import cache_folder

PACKAGE = Path(module.__file__).parent.parent
COMPILED = sorted(
    path for path in PACKAGE.rglob("*.py") if "edgeslam_torch.compiled import compiled" in path.read_text("utf-8")
)
SOURCE = """
import numpy as np
from edgeslam_torch.compiled import compiled

START = 2.0

@compiled("i8")
def filled(count):
    return np.zeros(count) + START
"""
MORE = """
@compiled()
def scaled(x, by):
    return START * x * by

@compiled("f8[:, ::1], i8[::1], f8, i8, b1, UniTuple(f8, 2), Tuple((f8[::1], u1[::1]))")
def summed(points, index, by, count, negative, offset, more):
    sums, first, start = np.zeros((len(index), count)), np.zeros(len(index), np.int64), filled(count)
    for n in range(len(index)):
        first[n] = index[0]
        for k in range(count):
            sums[n, k] = start[k] + scaled(points[index[n], k], by) + offset[0] - offset[1] + more[0][k] * more[1][k]
            if negative:
                sums[n, k] = -sums[n, k]
    return sums, first, sums.max(), count > 1
"""
RANDOM = np.random.default_rng(0)
ARGUMENTS = (
    RANDOM.normal(size=(4, 3)),
    np.array([2, 0]),
    1.5,
    3,
    True,
    (0.25, 1.0),
    (RANDOM.normal(size=3), np.array([1, 2, 255], np.uint8)),
)


@pytest.fixture
def source(tmp_path, monkeypatch):
    monkeypatch.setenv("EDGESLAM_CACHE", str(tmp_path / "user"))
    path = tmp_path / "package" / "loops.py"
    path.parent.mkdir()
    path.write_text(SOURCE)
    return path


def imported(path):
    """The module, as a new process would import it."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    loops = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loops)
    return loops


def kept(folder):
    return list(folder.rglob("*.loops"))


@pytest.fixture
def compilations(monkeypatch):
    """Names of functions as they are compiled."""
    names = []

    def counted(function, types, build=build.build):
        names.append(function.__name__)
        return build(function, types)

    monkeypatch.setattr(build, "build", counted)
    return names


def same(a, b):
    """Whether results are equal to the last bit, in type as well."""
    bits = [[(type(x), np.asarray(x).tobytes()) for x in results] for results in (a, b)]
    return bits[0] == bits[1]


def test_machine_code_gives_what_python_gives_in_the_first_run_and_from_the_cache(source, compilations):
    source.write_text(SOURCE + MORE)
    loops = imported(source)
    *arrays, largest, several = loops.summed.function(*ARGUMENTS)
    expected = *arrays, float(largest), several
    assert same(loops.summed(*ARGUMENTS), expected)
    assert loops.filled(1) == [2.0]
    assert compilations == ["filled", "summed"]
    loops = imported(source)
    assert same(loops.summed(*ARGUMENTS), expected)
    assert compilations == ["filled", "summed"]
    # Other types than those declared.
    strided = np.repeat(ARGUMENTS[0], 2, axis=0)[::2]
    assert same(loops.summed(strided, *ARGUMENTS[1:]), expected)


def test_errors_are_raised_and_calls_keep_nothing(source):
    filled = imported(source).filled
    with pytest.raises(ValueError, match="negative"):
        filled(-1)
    count = 10_000
    tracemalloc.start()
    for _ in range(100):
        filled(count)
    assert tracemalloc.get_traced_memory()[0] < count
    tracemalloc.stop()


@pytest.mark.parametrize("damaged", [lambda c: c[:-1], lambda c: b"", lambda c: c[:99] + bytes([c[99] ^ 1]) + c[100:]])
def test_a_damaged_file_and_a_changed_source_are_compiled_again(source, compilations, damaged):
    imported(source).filled(3)
    (file,) = kept(source.parent)
    file.write_bytes(damaged(file.read_bytes()))
    for _ in range(2):
        assert imported(source).filled(3).tolist() == [2.0] * 3
    source.write_text(SOURCE.replace("START = 2.0", "START = 30.0"))
    assert imported(source).filled(1) == [30.0]
    assert len(compilations) == 3


def test_another_processor_or_version_compiles_its_own(source, compilations, monkeypatch):
    imported(source).filled(3)
    with monkeypatch.context() as other:
        other.setattr(cache, "processor", lambda: ("x86_64-linux", "pentium4", ""))
        imported(source).filled(3)
    with monkeypatch.context() as other:
        other.setattr(cache.np, "__version__", "1.0")
        imported(source).filled(3)
    assert len(compilations) == 3
    imported(source).filled(3)  # a home directory that all use
    assert len(compilations) == 3


@pytest.mark.parametrize(("in_the_way", "count"), [(["__pycache__"], 1), (["__pycache__", "../user"], 2)])
def test_where_the_package_cannot_be_written_the_users_cache_is_used(source, compilations, in_the_way, count):
    """Without either, every process compiles."""
    for name in in_the_way:
        (source.parent / name).write_text("in the way")
    for _ in range(2):
        assert imported(source).filled(1) == [2.0]
    assert len(compilations) == count
    assert [file.parent.name for file in kept(source.parent.parent)] == ["user"] * (count == 1)


def test_nor_is_a_home_needed(source, monkeypatch):
    monkeypatch.delenv("EDGESLAM_CACHE")
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", lambda: (_ for _ in ()).throw(RuntimeError("no home")))
    assert imported(source).filled(1) == [2.0]


@pytest.mark.slow
def test_two_processes_at_once_share_a_cache(source):
    code = "import sys; sys.path.insert(0, sys.argv[1]); from loops import filled; print(filled(2))"
    command = [sys.executable, "-c", code, str(source.parent)]
    both = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    assert [p.communicate()[0] for p in both] == ["[2. 2.]\n"] * 2
    assert len(kept(source.parent)) == 1
    assert not list(source.parent.rglob("*.part"))
    command[2] += "; assert 'numba' not in sys.modules"
    again = subprocess.run(command, capture_output=True, text=True, check=True)
    assert (again.stdout, again.stderr) == ("[2. 2.]\n", "")


def test_a_missing_symbol_is_an_error_and_not_the_end_of_the_process(source):
    imported(source).filled(3)
    code = cache.load(source)["filled"]
    code.needed.append("no_such_function")
    with pytest.raises(OSError, match="no_such_function"):
        machine_code.link(code)


@pytest.mark.parametrize("renamed", ["_dynfunc", "_helperlib", "core.runtime._nrt_python"])
def test_a_version_of_numba_with_other_names_inside_links_itself(source, renamed, monkeypatch, caplog):
    imported(source).filled(3)
    known = machine_code._extension
    monkeypatch.setattr(machine_code, "_extension", lambda name: known(name.replace(renamed, "_no_longer_there")))
    machine_code._define_symbols.cache_clear()
    assert imported(source).filled(3).tolist() == [2.0] * 3
    assert "every run" in caplog.text
    machine_code._define_symbols.cache_clear()


ROWS = np.zeros((2, 3))


@pytest.mark.parametrize(
    ("types", "fitting", "others"),
    [
        ("f8", [1.0, 2, np.float64(1)], ["1", None, np.zeros(1)]),
        ("i8", [1, np.int32(1)], [1.0, np.float64(1)]),
        ("b1", [True, np.bool_(False)], [1]),
        ("u1[::1]", [np.zeros(3, np.uint8)], [np.zeros(3, np.int8), np.zeros((3, 1), np.uint8), [1]]),
        ("f8[:, ::1]", [ROWS, np.zeros((0, 3))], [np.asfortranarray(ROWS), np.zeros((2, 6))[:, ::2], ROWS.astype(">f8"),
                                                 np.broadcast_to(np.zeros(3), (2, 3)), np.ma.zeros((2, 3))]),
        ("UniTuple(f8, 2)", [(1.0, 2.0)], [(1.0,), [1.0, 2.0], (1.0, "2"), 1.0]),
        ("Tuple((f8[::1], i8))", [(np.zeros(1), 1)], [(1, np.zeros(1))]),
    ],
)  # fmt: skip
def test_types_of_arguments_are_checked(types, fitting, others):
    fits = parsed(types).fits
    assert all(fits((argument,)) for argument in fitting)
    assert not any(fits(arguments) for arguments in ((), (fitting[0], fitting[0]), *((other,) for other in others)))


def test_cache_folder_follows_the_environment(monkeypatch, tmp_path):
    monkeypatch.setenv("EDGESLAM_CACHE", str(tmp_path))
    assert cache_folder() == tmp_path
    monkeypatch.delenv("EDGESLAM_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "x"))
    assert cache_folder() == tmp_path / "x" / "edgeslam"


FLIGHT = """
from rendered import CAMERA, panels
from edgeslam_torch import EdgeSlam
from edgeslam_torch.compiled import Loops

slam = EdgeSlam(CAMERA, realtime={realtime})
del Loops.numba
for frame in panels().frames:
    slam.step(frame)
slam.finish()
print("landed")
"""


@pytest.mark.slow
@pytest.mark.parametrize("realtime", [True, False])
def test_nothing_is_compiled_once_the_system_is_made(realtime):
    """The camera does not wait for it, nor does it count in the times of a first run."""
    path = os.pathsep.join([str(Path(__file__).parent / "helpers"), *sys.path])
    environment = os.environ | {"PYTHONPATH": path}
    command = [sys.executable, "-c", FLIGHT.format(realtime=realtime)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.stdout == "landed\n", done.stderr


@pytest.mark.parametrize("path", COMPILED, ids=lambda path: path.stem)
def test_a_compiled_function_calls_only_those_of_its_own_file(path):
    """The cache does not notice changes of other files."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    ours = [n for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) and n.module.startswith("edgeslam_torch")]
    imported = {alias.asname or alias.name for node in ours for alias in node.names} - {"compiled"}
    loops = [n for n in tree.body if any("compiled(" in ast.unparse(d) for d in getattr(n, "decorator_list", ()))]
    calls = [n.func for loop in loops for n in ast.walk(loop) if isinstance(n, ast.Call)]
    assert loops
    assert not {call.id for call in calls if isinstance(call, ast.Name)} & imported
