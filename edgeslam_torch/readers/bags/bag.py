"""`Bag`: topics and messages of a ROS 1 bag, a ROS 2 folder or file, or an MCAP file, streamed by rosbags."""

import importlib
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from edgeslam_torch.errors import SourceError
from edgeslam_torch.extras import needs_extra

SUFFIXES = (".bag", ".db3", ".mcap")
METADATA = "metadata.yaml"
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
    struct.error,
)
"""What rosbags and the decompressors raise for damaged files, beside their own exceptions."""
_REMEDIES = (
    ("reindex", "it was not closed properly; repair it with: rosbag reindex"),
    ("index", "it was not closed properly; repair it with: rosbag reindex"),
    ("end magic", "it was not closed properly; repair it with: mcap recover"),
    ("Profile is not ros2", "it holds no ROS 2 messages"),
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
    """One message as it lies in the file."""

    topic: str
    received_s: float
    """When the recorder received it, Unix time [s]."""
    data: Any
    """Its bytes; `Bag.decode` reads them."""


def is_bag(path: Path) -> bool:
    """Whether a file or folder looks like a recording of ROS."""
    if path.is_dir():
        return bool(_storage_files(path))
    return path.suffix.lower() in SUFFIXES


class Bag:
    """A recording of ROS; every call of `messages` reads the file anew, a chunk at a time."""

    def __init__(self, path: Path) -> None:
        """List the topics.

        Raises:
            SourceError: If it cannot be read.
            MissingPackageError: If rosbags is not installed.
        """
        self.path = path
        self._file = _to_open(path)
        self._is_ros1 = self._file.suffix.lower() == ".bag"
        self._stores: dict[str, Any] = {}
        with self._opened() as reader:
            self.begin_s, self.end_s = 1e-9 * reader.start_time, 1e-9 * max(reader.start_time, reader.end_time - 1)
            counts: dict[str, tuple[str, int]] = {}
            self._definitions: dict[str, tuple[str, Any]] = {}
            for connection in reader.connections:
                kind, count = counts.get(connection.topic, (connection.msgtype, 0))
                counts[connection.topic] = (kind, count + (connection.msgcount if kind == connection.msgtype else 0))
                self._definitions.setdefault(connection.topic, (connection.msgtype, connection.msgdef))
        self.topics = tuple(Topic(name, _short(kind), count) for name, (kind, count) in sorted(counts.items()))

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
        with self._opened() as reader:
            wanted = [c for c in reader.connections if c.topic in names and c.msgtype == self._definitions[c.topic][0]]
            for connection, received_ns, data in reader.messages(wanted) if wanted else ():
                yield Raw(connection.topic, 1e-9 * received_ns, data)

    def first(self, name: str, count: int) -> list[tuple[Raw, Any]]:
        """The topic's first messages, and what they decode to."""
        return [(raw, self.decode(raw)) for raw in islice(self.messages([name]), count)]

    def decode(self, raw: Raw) -> Any:
        """The message with its fields as attributes, by the definition in the bag.

        Raises:
            SourceError: If the message is damaged, or the bag has no definition of its type.
        """
        kind = self._definitions[raw.topic][0]
        with self._no_damage(f"{self.path}: {raw.topic}"):
            store = self._store(raw.topic)
            read = store.deserialize_ros1 if self._is_ros1 else store.deserialize_cdr
            return read(raw.data, kind)

    def _store(self, topic: str) -> Any:
        """Type store that knows the topic's type: the bag's own definition, else ROS's."""
        kind, definition = self._definitions[topic]
        if kind in self._stores:
            return self._stores[kind]
        with needs_extra("bags", f"{self.path}: a ROS bag"):
            from rosbags.interfaces import MessageDefinitionFormat
            from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
        if definition.format is MessageDefinitionFormat.NONE:
            store = get_typestore(Stores.ROS1_NOETIC if self._is_ros1 else Stores.LATEST)
            if kind not in store.fielddefs:
                raise SourceError(f"{self.path}: {topic}: the bag holds no definition of {_short(kind)}")
        else:
            store = get_typestore(Stores.EMPTY)
            if definition.format is MessageDefinitionFormat.MSG:
                store.register(get_types_from_msg(definition.data, kind))
            else:
                for part in definition.data.split("=" * 80 + "\n"):
                    store.register(get_types_from_idl(part.split("\n", 1)[1] if part.startswith("IDL: ") else part))
        self._stores[kind] = store
        return store

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        with needs_extra("bags", f"{self.path}: a ROS bag"):
            from rosbags.rosbag1 import Reader as Reader1
            from rosbags.rosbag2 import Reader as Reader2
        with self._no_damage(str(self.path)), (Reader1 if self._is_ros1 else Reader2)(self._file) as reader:
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
    return ReaderError1, ReaderError2, SerdeError, TypesysError, apsw.Error, zstd.ZstdError


def _storage_files(folder: Path) -> list[Path]:
    """Files of a ROS 2 recording in a folder."""
    return sorted(
        child for child in folder.iterdir() if child.suffix.lower() in SUFFIXES[1:] or child.name.endswith(".db3.zstd")
    )


def _to_open(path: Path) -> Path:
    """What rosbags opens: a file, or a folder with its metadata."""
    if path.is_dir() and not (path / METADATA).is_file():
        files = _storage_files(path)
        if len(files) != 1:
            names = ", ".join(file.name for file in files[:4])
            raise SourceError(f"{path}: no {METADATA} beside {names}; give one of these files")
        return files[0]
    return path


def _short(kind: str) -> str:
    """``sensor_msgs/Image`` of ``sensor_msgs/msg/Image``."""
    return kind.replace("/msg/", "/")
