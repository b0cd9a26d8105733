"""A disk that fills up while one file is written."""

from edgeslam_torch.files import appender, plain


class FullDisk:
    """Files of a name: while ``room`` is set, a write leaves that many bytes and says so, as POSIX has it.

    Args:
        monkeypatch: Undoes it.
        name: Of the files.
    """

    def __init__(self, monkeypatch, name):
        self.room = None
        opened = plain.create

        def create_on_it(path):
            file = opened(path)
            return _File(file, self) if path.name == name else file

        monkeypatch.setattr(appender, "create", create_on_it)


class _File:
    def __init__(self, file, disk):
        self.file, self.disk = file, disk

    def write(self, data):
        return self.file.write(data[: self.disk.room])

    def __getattr__(self, name):
        return getattr(self.file, name)
