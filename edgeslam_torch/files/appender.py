"""A text file that contains only whole lines, even on a full disk."""

import errno
import os
from pathlib import Path

from edgeslam_torch.files.plain import create, extend


class Appender:
    """Appends lines; a line that does not fit on the disk is removed completely.

    Args:
        path: The file.
        header: First lines of a new file, which replaces an old one; None appends to an existing file.

    Raises:
        OSError: If the file cannot be opened or written.
    """

    def __init__(self, path: Path, header: str | None) -> None:
        self._file = extend(path) if header is None else create(path)
        self._good = self._file.seek(0, os.SEEK_END)
        if header is not None:
            self.write(header)

    def write(self, text: str) -> None:
        """Append whole lines.

        Raises:
            OSError: If the disk is full; the file is unchanged.
        """
        data = text.encode("utf-8")
        try:
            written = self._file.write(data)
            if written != len(data):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError:
            self._file.truncate(self._good)
            self._file.seek(self._good)
            raise
        self._good += len(data)

    def close(self) -> None:
        """Close the file."""
        self._file.close()
