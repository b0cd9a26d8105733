"""`RosFile`: an MCAP file of ROS 2 messages; rosbags encodes them, the mcap library writes them."""

import io
import os
from pathlib import Path
from typing import Any

from edgeslam_torch.errors import OutputError
from edgeslam_torch.extras import needs_extra
from edgeslam_torch.files.atomic import partial_beside
from edgeslam_torch.files.plain import open_exclusively


class RosFile:
    """Grows beside its final name, and gets the name when it is complete."""

    def __init__(self, path: Path) -> None:
        """Check that the file can be written.

        Raises:
            OutputError: If it cannot.
            MissingPackageError: If rosbags or mcap is not installed.
        """
        with needs_extra("bags", "--save-mcap"):
            from mcap.writer import Writer
            from rosbags.typesys import Stores, get_typestore

        self.path = path
        self._part = partial_beside(path)
        self._store: Any = get_typestore(Stores.ROS2_HUMBLE)
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        try:
            if path.is_dir():
                raise OutputError(f"{path}: is a folder; give a file, such as {path / 'run.mcap'}")
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = io.BufferedWriter(open_exclusively(self._part))
        except OSError as error:
            raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from error
        self._writer: Any = Writer(self._file)
        self._writer.start(profile="ros2", library="edgeslam-torch")
        self._messages = 0

    def make(self, kind: str, **fields: Any) -> Any:
        """A message of a type such as ``nav_msgs/msg/Path``."""
        return self._store.types[kind](**fields)

    def write(self, topic: str, stamp_s: float, message: Any) -> None:
        """Append a message.

        Raises:
            OSError: If the disk is full.
        """
        kind = message.__msgtype__
        if kind not in self._schemas:
            text = self._store.generate_msgdef(kind, ros_version=2)[0]
            self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", text.encode())
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schemas[kind])
        at_ns = max(0, round(stamp_s * 1e9))
        data = bytes(self._store.serialize_cdr(message, kind))
        self._writer.add_message(self._channels[topic], at_ns, data, at_ns, self._messages)
        self._messages += 1

    def close(self) -> None:
        """Complete the file and give it its name; a file without messages is removed.

        Raises:
            OSError: If the disk is full.
        """
        if self._file.closed:
            return
        if not self._messages:
            self.abandon()
            return
        self._writer.finish()
        self._file.close()
        os.replace(self._part, self.path)

    def abandon(self) -> None:
        """Remove what was written."""
        self._file.close()
        self._part.unlink(missing_ok=True)
