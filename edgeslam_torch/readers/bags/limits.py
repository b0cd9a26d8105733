"""Limits for untrusted bags: decompression, SQL and message definitions.

rosbags decompresses a chunk of any size, runs whatever a database calls its tables, and compiles message definitions to
Python. A file of a few kilobytes can thus take all memory, never end, or reach the compiler with names of its own.
"""

import math
import re
from bz2 import BZ2Decompressor
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

from edgeslam_torch.errors import SourceError

MAX_CHUNK_BYTES = 1 << 28
"""Of one chunk or message, decompressed: 256 MiB; recorders write chunks of .8 to 4 MB, pictures have up to 200 MB."""
MAX_METADATA_BYTES = 1 << 22
"""Of ``metadata.yaml``; a recording split into ten thousand files has 2 MB."""
MAX_FILE_RATIO = 50
"""A bag compressed as a whole file may grow so many times; real ones stay below ten."""
_MAX_DEFINITION_CHARS = 1 << 16
_MAX_FIELDS = 1000
_MAX_NUMBERS, _MAX_ITEMS = 1 << 16, 1 << 10
"""Elements of a fixed array: of numbers, and of anything whose reading is unrolled."""
_MAX_LISTED_BYTES = 1 << 22
"""Of a message with arrays of messages or texts, which become Python objects, 70 times their bytes."""
_SQL_STEPS = 100_000
"""Virtual-machine instructions between two looks at Ctrl-C: a few milliseconds."""
_COMPUTED = "SELECT 1 FROM sqlite_schema AS t, pragma_table_xinfo(t.name) WHERE hidden > 1"
"""Columns that are computed when they are read."""
_TYPE = re.compile(r"[A-Za-z]\w*(/[A-Za-z]\w*)*", re.ASCII)
_NAME = re.compile(r"[A-Za-z]\w*", re.ASCII)
_COMMENT_OR_TEXT = re.compile(r'//[^\n]*|/\*.*?\*/|"(?:[^"\\\n]|\\.)*"', re.DOTALL)
_ARITHMETIC = re.compile(r"<<|>>|[*%~^|&]|\d{20}")


def chunk_bytes(compression: str, data: bytes) -> bytes:
    """Decompress one chunk or message: ``""``, ``none``, ``bz2``, ``lz4`` or ``zstd``.

    Raises:
        SourceError: If it is larger than `MAX_CHUNK_BYTES`, or compressed by anything else.
    """
    from lz4.frame import LZ4FrameDecompressor

    if compression in ("", "none"):
        return data
    known: dict[str, Callable[[], Any]] = {
        "bz2": BZ2Decompressor,
        "lz4": LZ4FrameDecompressor,
        "zstd": lambda: _zstd().ZstdDecompressor(),
    }
    if compression not in known:
        raise SourceError(f"chunks compressed by {compression[:20]!r} are not read")
    decompressor = known[compression]()
    out: bytes = decompressor.decompress(data, MAX_CHUNK_BYTES + 1)
    if len(out) > MAX_CHUNK_BYTES:
        raise SourceError(f"a chunk of more than {MAX_CHUNK_BYTES >> 20} MiB is not read")
    if not decompressor.eof:
        raise EOFError("a compressed chunk ends in the middle")
    return out


def _zstd() -> Any:
    """The module that rosbags uses: backports.zstd before Python 3.14, compression.zstd since."""
    from rosbags.rosbag2 import storage_mcap

    return storage_mcap.zstd


def readers() -> tuple[Callable[[Path], Any], Callable[[Path], Any]]:
    """rosbags' readers of ROS 1 and ROS 2, within the bounds of this module."""
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag1 import reader as reader1
    from rosbags.rosbag2 import Reader as Reader2
    from rosbags.rosbag2 import storage_mcap
    from rosbags.rosbag2.reader import DirectoryReader, McapReader, Sqlite3Reader

    # Its own tables of decompressors are replaced: they have no other way to be bounded.
    reader1.decompressors.update({name: partial(chunk_bytes, name) for name in ("bz2", "lz4")})
    storage_mcap.DECOMPRESSORS["lz4"] = lambda data, _: chunk_bytes("lz4", data)
    storage_mcap.DECOMPRESSORS["zstd"] = lambda data, _: chunk_bytes("zstd", data)

    class Sqlite(Sqlite3Reader):
        def __init__(self, path: Path) -> None:
            super().__init__(_UriPath(path))

        def open(self) -> None:
            with _sql_is_read_only_data():
                super().open()

    class Folder(DirectoryReader):
        STORAGE_PLUGINS = {"mcap": McapReader, "sqlite3": Sqlite}

        def open(self) -> None:
            _check_folder(Path(str(self.path)))
            super().open()
            self._packed = self.metadata.compression_mode == "message"
            self.metadata = self.metadata._replace(compression_mode=None)

        def messages(self, *args: Any, **kwargs: Any) -> Any:
            for connection, stamp, data in super().messages(*args, **kwargs):
                yield connection, stamp, chunk_bytes("zstd", data) if self._packed else data

    class Either(Reader2):
        STORAGE_PLUGINS = {"dir": Folder, ".mcap": McapReader, ".db3": Sqlite}

    return Reader1, Either


class _UriPath(type(Path())):  # type: ignore[misc]
    """A path whose text is a part of a URI, as rosbags gives it to SQLite: ``#``, ``%`` and ``?`` are quoted."""

    def __str__(self) -> str:
        return super().__str__().replace("%", "%25").replace("#", "%23").replace("?", "%3f")


@contextmanager
def _sql_is_read_only_data() -> Iterator[None]:
    """Databases opened inside hold stored tables alone: no views, no computed columns, nothing recursive; Ctrl-C ends
    what they compute."""
    import apsw

    def authorise(action: int, *names: str | None) -> int:
        *_, view = names
        return int(apsw.SQLITE_DENY if view is not None or action == apsw.SQLITE_RECURSIVE else apsw.SQLITE_OK)

    def bound(connection: Any) -> None:
        connection.limit(apsw.SQLITE_LIMIT_LENGTH, MAX_CHUNK_BYTES)
        connection.authorizer = authorise
        connection.set_progress_handler(lambda: False, _SQL_STEPS)  # Python runs its signal handlers there
        if connection.execute(_COMPUTED).fetchone() is not None:
            raise SourceError(f"{connection.filename}: a table with computed columns is not read")

    apsw.connection_hooks.append(bound)
    try:
        yield
    finally:
        apsw.connection_hooks.remove(bound)


def _check_folder(folder: Path) -> None:
    """Size of the metadata, and what whole files grow to that are compressed as such."""
    metadata = folder / "metadata.yaml"
    if metadata.stat().st_size > MAX_METADATA_BYTES:
        raise SourceError(f"{metadata}: more than {MAX_METADATA_BYTES >> 20} MiB of metadata are not read")
    if not re.search(r"compression_mode:\s*[\"']?file\b", metadata.read_text("utf-8", "replace"), re.IGNORECASE):
        return
    for file in folder.iterdir():
        if file.suffix == ".zstd":
            most = MAX_FILE_RATIO * file.stat().st_size + MAX_CHUNK_BYTES
            with file.open("rb") as packed, _zstd().open(packed, "rb") as stream:
                _check_length(stream, most, file)


def _check_length(stream: BinaryIO, most: int, file: Path) -> None:
    length = 0
    while block := stream.read(1 << 20):
        length += len(block)
        if length > most:
            raise SourceError(f"{file}: grows to more than {MAX_FILE_RATIO} times its size; it is not read")


def check_definition_text(text: str, topic: str, idl: bool) -> None:
    """Refuse a message definition whose parsing or constants might not terminate.

    Raises:
        SourceError: If it is longer than any real one, or computes its constants.
    """
    if len(text) > _MAX_DEFINITION_CHARS:
        raise SourceError(f"{topic}: a message definition of {len(text)} characters is not read")
    if idl and _ARITHMETIC.search(_COMMENT_OR_TEXT.sub("", text)):
        raise SourceError(f"{topic}: a message definition that computes its constants is not read")


def check_types(types: Any, topic: str) -> None:
    """Refuse parsed message types that are not plain names, numbers and bounded arrays: they become Python code.

    Args:
        types: rosbags' dictionary of type to ``(constants, fields)``.
        topic: For messages.

    Raises:
        SourceError: If a name, a constant or a size is out of the grammar's bounds.
    """

    def plain(pattern: re.Pattern[str], name: object) -> None:
        if not (isinstance(name, str) and pattern.fullmatch(name)):
            raise SourceError(f"{topic}: {str(name)[:40]!r} is not a name in a message definition")

    for kind, (constants, fields) in types.items():
        plain(_TYPE, kind)
        if len(fields) + len(constants) > _MAX_FIELDS:
            raise SourceError(f"{topic}: {len(fields) + len(constants)} fields in one message are not read")
        for name, base, value in constants:
            plain(_NAME, name)
            plain(_NAME, base)
            if not isinstance(value, bool | int | float | str) or value in (math.inf, -math.inf):
                raise SourceError(f"{topic}: constant {name} is neither a finite number nor text")
        for name, (node, detail) in fields:
            plain(_NAME, name)
            is_array = int(node) in (3, 4)
            inner, size = (detail[0][1], detail[1]) if is_array else (detail, 1)
            base = inner if isinstance(inner, str) else inner[0]
            plain(_TYPE, base)
            numbers = not isinstance(inner, str) and base not in ("string", "wstring")
            if int(node) == 3 and not 0 < size <= (_MAX_NUMBERS if numbers else _MAX_ITEMS):
                raise SourceError(f"{topic}: an array of {size} {base} in a message is not read")


def check_message(types: Any, kind: str, data: Any, topic: str) -> None:
    """Refuse a message of many bytes whose arrays would become objects rather than numbers.

    Args:
        types: As for `check_types`, which they have passed.
        kind: The message's type.
        data: Its bytes.
        topic: For messages.

    Raises:
        SourceError: If it would take far more memory than its bytes.
    """
    if len(data) <= _MAX_LISTED_BYTES:
        return
    found, left = {kind}, [kind]
    while left:
        for _, (node, detail) in types[left.pop()][1]:
            inner = detail[0][1] if int(node) in (3, 4) else detail
            base = inner if isinstance(inner, str) else inner[0]
            if int(node) in (3, 4) and (base == inner or base in ("string", "wstring")):
                raise SourceError(f"{topic}: a message of {len(data)} bytes with a list of {base} is not read")
            if isinstance(inner, str) and inner not in found:
                found.add(inner)
                left.append(inner)
