"""`Bag`: topics and messages of a ROS 1 bag, a ROS 2 folder or file, or an MCAP file, one or split, streamed."""

import importlib
import math
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

from edgeslam_torch.errors import SourceError
from edgeslam_torch.extras import needs_extra
from edgeslam_torch.files.time_units import MAX_STAMP_S
from edgeslam_torch.readers.bags.limits import check_definition_text, check_message, check_types, readers
from edgeslam_torch.readers.bags.mcap_file import McapFile, profile

SUFFIXES = (".bag", ".db3", ".mcap")
METADATA = "metadata.yaml"
_UNFINISHED = ".active"
"""What a recorder appends to the name while it writes."""
_MAX_GAP_S, _MAX_OVERLAP_S = 10.0, 1.0
"""Maximum gap between files of a split recording: recorders leave tenths of a second, separate recordings minutes."""
_DAMAGED = (
    OSError,
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    AssertionError,
    ArithmeticError,
    EOFError,
    RuntimeError,
    MemoryError,
    struct.error,
)
"""What rosbags and the decompressors raise for damaged files, beside their own exceptions."""
_REMEDIES = (
    ("reindex", "it was not closed properly; repair it with: rosbag reindex"),
    ("index", "it was not closed properly; repair it with: rosbag reindex"),
    ("end magic", "it was not closed properly; repair it with: mcap recover"),
    ("image is malformed", "its database is damaged; repair it with: sqlite3 DAMAGED.db3 .recover | sqlite3 NEW.db3"),
)


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic of a bag."""

    name: str
    kind: str
    """Message type, as ``sensor_msgs/Image`` for both versions of ROS."""
    count: int
    """Messages."""


@dataclass(frozen=True, slots=True)
class Raw:
    """One undecoded message."""

    topic: str
    received_s: float
    """When the recorder received it, Unix time [s]."""
    data: Any
    """Its bytes; `Bag.decode` reads them."""


def is_bag(path: Path) -> bool:
    """Whether a file or folder looks like a recording of ROS."""
    if path.is_dir():
        return bool(_storage_files(path))
    return path.name.lower().removesuffix(_UNFINISHED).endswith(SUFFIXES)


class Bag:
    """A recording of ROS; every call of `messages` reads the file anew, a chunk at a time."""

    def __init__(self, path: Path) -> None:
        """List the topics.

        Raises:
            SourceError: If it cannot be read.
            MissingPackageError: If rosbags is not installed.
        """
        self.path = path
        self._files = _files(path)
        self._stores: dict[str, Any] = {}
        self._definitions: dict[str, tuple[str, Any, bool]] = {}
        """Topic to type, definition and whether its messages are encoded as in ROS 1."""
        counts: dict[str, int] = {}
        spans: list[tuple[float, float, Path]] = []
        for file in self._files:
            with self._opened(file) as reader:
                spans.append((1e-9 * reader.start_time, 1e-9 * max(reader.start_time, reader.end_time - 1), file))
                for connection in reader.connections:
                    name, kind, count = connection.topic, connection.msgtype, connection.msgcount
                    if not (isinstance(name, str) and isinstance(kind, str) and isinstance(count, int)):
                        raise ValueError(f"topic {str(name)[:40]!r} has no name, type or count")
                    is_ros1 = _is_ros1(file) or connection.ext.serialization_format == "ros1"
                    first = self._definitions.setdefault(name, (kind, connection.msgdef, is_ros1))
                    counts[name] = counts.get(name, 0) + (count if kind == first[0] else 0)
        filled = sorted(span for span in spans if span[1] < 2**62 * 1e-9)
        if not all(math.isfinite(begin) for begin, _, _ in filled):
            raise SourceError(f"{path}: receive times that are not numbers")
        self._files = [file for _, _, file in filled] or self._files
        for (_, end, one), (begin, _, other) in pairwise(filled):
            if not end - _MAX_OVERLAP_S <= begin <= end + _MAX_GAP_S:
                raise SourceError(f"{path}: {one.name} and {other.name} do not follow each other; give one of them")
        self.begin_s, self.end_s = (filled[0][0], filled[-1][1]) if filled else (0.0, 0.0)
        self.topics = tuple(Topic(name, _short(self._definitions[name][0]), counts[name]) for name in sorted(counts))

    @property
    def duration_s(self) -> float:
        """From the first to the last message [s]."""
        return self.end_s - self.begin_s if any(topic.count for topic in self.topics) else 0.0

    def messages(self, names: Sequence[str]) -> Iterator[Raw]:
        """Messages of these topics in the order of their receipt.

        Raises:
            SourceError: If the file ends in the middle or is damaged.
        """
        if not names:
            return
        for file in self._files:
            with self._opened(file) as reader:
                known = self._definitions
                wanted = [c for c in reader.connections if c.topic in names and c.msgtype == known[c.topic][0]]
                for connection, received_ns, data in reader.messages(wanted) if wanted else ():
                    received_s = 1e-9 * received_ns
                    if not abs(received_s) <= MAX_STAMP_S:
                        raise ValueError("a receive time that cannot be one")
                    yield Raw(connection.topic, received_s, data)

    def first(self, name: str, count: int) -> list[tuple[Raw, Any]]:
        """The topic's first messages, and what they decode to."""
        return [(raw, self.decode(raw)) for raw in islice(self.messages([name]), count)]

    def decode(self, raw: Raw) -> Any:
        """The message with its fields as attributes, by the definition in the bag.

        Raises:
            SourceError: If the message is damaged, or the bag has no definition of its type.
        """
        kind, _, is_ros1 = self._definitions[raw.topic]
        with self._no_damage(f"{self.path}: {raw.topic}"):
            store = self._store(raw.topic)
            check_message(store.fielddefs, kind, raw.data, raw.topic)
            read = store.deserialize_ros1 if is_ros1 else store.deserialize_cdr
            return read(raw.data, kind)

    def _store(self, topic: str) -> Any:
        """Type store with the topic's type: the bag's own definition, else ROS's."""
        kind, definition, is_ros1 = self._definitions[topic]
        if kind in self._stores:
            return self._stores[kind]
        with needs_extra("bags", f"{self.path}: a ROS bag"):
            from rosbags.interfaces import MessageDefinitionFormat
            from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
        if definition.format is MessageDefinitionFormat.NONE:
            store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.LATEST)
            if kind not in store.fielddefs:
                raise SourceError(f"{self.path}: {topic}: the bag holds no definition of {_short(kind)}")
        else:
            store = get_typestore(Stores.EMPTY)
            is_idl = definition.format is not MessageDefinitionFormat.MSG
            check_definition_text(definition.data, topic, is_idl)
            parts = definition.data.split("=" * 80 + "\n") if is_idl else ()
            for part in parts:
                types = get_types_from_idl(part.split("\n", 1)[1] if part.startswith("IDL: ") else part)
                check_types(types, topic)
                store.register(types)
            if not is_idl:
                types = get_types_from_msg(definition.data, kind)
                check_types(types, topic)
                store.register(types)
        self._stores[kind] = store
        return store

    @contextmanager
    def _opened(self, file: Path) -> Iterator[Any]:
        for part in (file, *(file.iterdir() if file.is_dir() else ())):
            if part.exists() and not (part.is_file() or part.is_dir()):  # its readers would wait for a pipe
                raise SourceError(f"{part}: is not a regular file")
        with needs_extra("bags", f"{self.path}: a ROS bag"):
            ros1, ros2 = readers()
        with self._no_damage(str(self.path)):
            if not _is_ros1(file) and file.is_file() and profile(file) not in (None, "ros2"):
                with needs_extra("bags", f"{file}: an MCAP file"), McapFile(file) as reader:
                    yield reader
            else:
                with (ros1 if _is_ros1(file) else ros2)(file) as reader:
                    yield reader

    @contextmanager
    def _no_damage(self, name: str) -> Iterator[None]:
        """What the libraries raise for damaged files, as one line."""
        try:
            yield
        except SourceError:
            raise
        except Exception as error:
            if not isinstance(error, (*_DAMAGED, *_library_errors())):
                raise
            words = " ".join(str(error).split())[:160] or type(error).__name__
            remedy = next((remedy for part, remedy in _REMEDIES if part in words), None)
            raise SourceError(f"{name}: cannot be read as a recording of ROS: {remedy or words}") from error


def _library_errors() -> tuple[type[Exception], ...]:
    """Exceptions of rosbags and of what it reads files with."""
    with needs_extra("bags", "a ROS bag"):
        import apsw
        from rosbags.rosbag1 import ReaderError as ReaderError1
        from rosbags.rosbag2 import ReaderError as ReaderError2
        from rosbags.serde import SerdeError
        from rosbags.typesys import TypesysError

        # backports.zstd before Python 3.14, compression.zstd since
        zstd = importlib.import_module("rosbags.rosbag2.storage_mcap").zstd
    with needs_extra("bags", "an MCAP file"):
        from mcap.exceptions import McapError
    return ReaderError1, ReaderError2, SerdeError, TypesysError, apsw.Error, zstd.ZstdError, McapError


def _is_ros1(file: Path) -> bool:
    return file.name.lower().removesuffix(_UNFINISHED).endswith(".bag")


def _storage_files(folder: Path) -> list[Path]:
    """Files of a recording in a folder; ``.bag`` files count where nothing else lies beside them."""
    children = sorted(folder.iterdir())
    ros2 = [c for c in children if c.suffix.lower() in SUFFIXES[1:] or c.name.endswith(".db3.zstd")]
    only_bags = bool(children) and all(c.is_file() and c.suffix.lower() in (".bag", ".yaml", ".txt") for c in children)
    return ros2 or [c for c in children if only_bags and c.suffix.lower() == ".bag"]


def _files(path: Path) -> list[Path]:
    """What is opened one after the other: a file, a folder with its metadata, or the files of one without."""
    if not path.is_dir() or (path / METADATA).is_file():
        return [path]
    files = _storage_files(path)
    if len({file.suffix.lower() for file in files}) > 1:
        raise SourceError(
            f"{path}: no {METADATA} beside {', '.join(f.name for f in files[:4])}; give one of these files"
        )
    return files


def _short(kind: str) -> str:
    """``sensor_msgs/Image`` of ``sensor_msgs/msg/Image``."""
    return kind.replace("/msg/", "/")
