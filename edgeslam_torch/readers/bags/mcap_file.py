"""`McapFile`: an MCAP file of ROS 1, or without a profile, which rosbags does not read; by MCAP's own library."""

import struct
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

from edgeslam_torch.readers.bags.limits import MAX_CHUNK_BYTES, chunk_bytes

_MAGIC = b"\x89MCAP0\r\n"


def profile(path: Path) -> str | None:
    """``ros1``, ``ros2`` or another profile of an MCAP file; None if it is no MCAP file.

    https://mcap.dev/spec: magic, opcode 1 of the header, its length, length and text of the profile.
    """
    with path.open("rb") as file:
        head = file.read(8 + 1 + 8 + 4 + 32)
    if not head.startswith(_MAGIC + b"\x01"):
        return None
    length = int.from_bytes(head[17:21], "little")
    return head[21 : 21 + length].decode("utf-8", "replace")


class McapFile:
    """The part of rosbags' reader that `Bag` uses: connections, first and last time, messages in the file's order."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.connections: list[Any] = []
        self.start_time, self.end_time = 2**63 - 1, 0
        """Of the first message, and 1 ns after the last [ns]."""

    def __enter__(self) -> Self:
        from mcap.exceptions import McapError
        from mcap.reader import SeekingReader

        self._file = self._path.open("rb")
        self._file.seek(-len(_MAGIC), 2)
        if self._file.read() != _MAGIC:
            raise EOFError("File end magic is missing")
        summary = None
        with suppress(McapError, ValueError, struct.error):  # a damaged index: the file itself is read
            summary = SeekingReader(self._file, record_size_limit=MAX_CHUNK_BYTES).get_summary()
        if summary is not None and summary.statistics is not None and summary.channels:
            counts = dict(summary.statistics.channel_message_counts)
            channels, schemas = summary.channels, summary.schemas
            times = [summary.statistics.message_start_time, summary.statistics.message_end_time]
        else:
            counts, channels, schemas, times = {}, {}, {}, []
            for record in self._records():
                name = type(record).__name__
                if name == "Message":
                    counts[record.channel_id] = counts.get(record.channel_id, 0) + 1
                    times = [min([record.log_time, *times]), max([record.log_time, *times])]
                elif name == "Channel":
                    channels[record.id] = record
                elif name == "Schema":
                    schemas[record.id] = record
        if times and any(counts.values()):
            self.start_time, self.end_time = times[0], times[1] + 1
        self.connections = [
            _connection(channel, schemas.get(channel.schema_id), counts.get(channel.id, 0), self)
            for channel in channels.values()
        ]
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def messages(self, connections: Sequence[Any]) -> Iterator[tuple[Any, int, bytes]]:
        """Connection, time of receipt [ns] and bytes of each message."""
        wanted = {connection.id: connection for connection in connections}
        for record in self._records():
            if type(record).__name__ == "Message" and record.channel_id in wanted:
                yield wanted[record.channel_id], record.log_time, record.data

    def _records(self) -> Iterator[Any]:
        """All records, those in chunks among them; a chunk at a time is in memory."""
        from mcap.stream_reader import StreamReader, breakup_chunk

        self._file.seek(0)
        records: Iterator[Any] = StreamReader(self._file, emit_chunks=True, record_size_limit=MAX_CHUNK_BYTES).records
        for record in records:
            if type(record).__name__ == "Chunk":
                data = chunk_bytes(record.compression, record.data)
                yield from breakup_chunk(replace(record, compression="", data=data))
            else:
                yield record


def _connection(channel: Any, schema: Any, count: int, owner: McapFile) -> Any:
    from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat
    from rosbags.typesys.msg import normalize_msgtype

    formats = {
        "ros1msg": MessageDefinitionFormat.MSG,
        "ros2msg": MessageDefinitionFormat.MSG,
        "ros2idl": MessageDefinitionFormat.IDL,
        "omgidl": MessageDefinitionFormat.IDL,
    }
    form = formats.get("" if schema is None else schema.encoding, MessageDefinitionFormat.NONE)
    name = "" if schema is None else schema.name
    kind = normalize_msgtype(name) if form is MessageDefinitionFormat.MSG else name
    text = "" if form is MessageDefinitionFormat.NONE else schema.data.decode("utf-8", "replace")
    ext = ConnectionExtRosbag2(channel.message_encoding, [])
    return Connection(channel.id, channel.topic, kind, MessageDefinition(form, text), "", count, ext, owner)
