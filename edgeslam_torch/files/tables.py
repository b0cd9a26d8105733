"""Tables in text files: lists of images, trajectories, telemetry, as data sets and spreadsheets write them.

Encoding (UTF-8 or UTF-16, with or without a byte order mark), separator (tab, semicolon, comma, blanks), quotes,
decimal commas, comments and header are recognised; what is not understood is refused in one line.
"""

import csv
import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from edgeslam_torch.errors import EdgeSlamError
from edgeslam_torch.files.plain import read_bounded
from edgeslam_torch.types import FloatArray

MAX_BYTES = 256 << 20
"""Default limit; a million poses take 100 MB."""
MAX_LINES, MAX_CELLS = 2_000_000, 30_000_000
"""Maximum numbers; a line takes half a kilobyte of memory, a cell 60 bytes. An IMU writes so many in three hours."""
_COMMENTS = ("#", "%")
"""First characters of comment lines; ``%`` is that of MATLAB and of ``rostopic echo -p``."""
_LOOKED_AT = 200
"""Rows by which the separator is chosen."""
_BLANKS = " "
_SEPARATORS = ("\t", ";", ",", _BLANKS)
"""In this order when several fit."""
_MIXED = re.compile(r"\s*[,;\t]\s*|\s+")
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?|[+-]?\d+,")


class Row(NamedTuple):
    """One line with data."""

    line: int
    """Its number in the file, from 1."""
    cells: list[str]
    """Without quotes and surrounding blanks."""


@dataclass(frozen=True, slots=True)
class Table:
    """A text table; cells are text until `number` or `numbers` reads them."""

    path: Path
    header: tuple[str, ...]
    """Names of the columns, from a first line without numbers or from the last comment above the rows if it has as many
    words as they; empty without any."""
    rows: tuple[Row, ...]
    comments: tuple[str, ...]
    """Comment lines, without their mark."""
    error: type[EdgeSlamError]
    """Raised by `numbers`."""
    ends_within_line: bool = False
    """Whether the file ends without an end of line: the last row may be incomplete."""

    def numbers(self, columns: Sequence[int] | None = None) -> FloatArray:
        """The cells as numbers, ``(rows, columns)`` float64; ``nan`` and ``inf`` are numbers.

        An incomplete row at the end of the file is left out.

        Args:
            columns: Indices of the columns to read; default: all, of which each row must have the same number.

        Raises:
            EdgeSlamError: The table's error, which names file, line and column of what is no number.
        """
        rows = list(self.rows)
        width = len(rows[0].cells) if columns is None and rows else 1 + max(columns or (0,))
        if len(rows) > 1 and self.ends_within_line and len(rows[-1].cells) < width:
            rows.pop()
        for row in rows:
            if len(row.cells) < width or (columns is None and len(row.cells) > width):
                other = f", line {rows[0].line} has {width}" if columns is None else f", {width} are needed"
                raise self.error(f"{self.path}: line {row.line} has {len(row.cells)} columns{other}")
        wanted = range(width) if columns is None else columns
        cells = [[row.cells[i] for i in wanted] for row in rows]
        try:
            return np.array(cells, dtype=np.float64).reshape(len(rows), len(wanted))
        except ValueError:  # decimal commas, or a cell to be named
            pass
        return np.array([[self._number(row, i) for i in wanted] for row in rows])

    def _number(self, row: Row, i: int) -> float:
        value = number(row.cells[i])
        if value is None:
            name = f" ({self.header[i]})" if i < len(self.header) else ""
            raise self.error(
                f"{self.path}: line {row.line}, column {i + 1}{name} is not a number: {row.cells[i][:40]!r}"
            )
        return value


def number(text: str) -> float | None:
    """A number with a decimal point or comma; None for anything else.

    Example:
        >>> number("1305031102,175304"), number("2.5e-3"), number("1_000"), number("12cm")
        (1305031102.175304, 0.0025, None, None)
    """
    try:
        return float(text) if "_" not in text else None
    except ValueError:
        return float(text.replace(",", ".")) if _DECIMAL_COMMA.fullmatch(text.strip()) else None


def read_text(path: Path, error: type[EdgeSlamError], max_bytes: int = MAX_BYTES) -> str:
    """Text of a file in UTF-8 or UTF-16.

    Raises:
        EdgeSlamError: ``error``, if it is no file, cannot be read, is too large, or is no such text.
    """
    data = read_bounded(path, max_bytes, error, "a text table")
    encoding = _encoding(data)
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError as reason:
        remedy = "not a text file, or not in UTF-8; if it is a table, save it as UTF-8"
        raise error(f"{path}: {remedy} (byte {reason.start} is {data[reason.start]:#04x})") from reason
    if "\0" in text:
        raise error(f"{path}: not a text file (it holds NUL characters)")
    return text


def read_table(path: Path, error: type[EdgeSlamError], columns: int | None = None, max_bytes: int = MAX_BYTES) -> Table:
    """Rows of a text table.

    Args:
        path: The file.
        error: Exception class to raise.
        columns: Number of columns, if the last one is text that may contain the separator (a file's name).
        max_bytes: Limit of its size.

    Raises:
        EdgeSlamError: As `read_text`.
    """
    text = read_text(path, error, max_bytes)
    _check_counts(text, path, error)
    lines = [(i, line.strip("\r\v\f ")) for i, line in enumerate(text.split("\n"), start=1)]
    if "\r" in text and "\r\n" not in text and "\n" not in text:  # line ends of old Macs
        lines = [(i, line.strip()) for i, line in enumerate(text.split("\r"), start=1)]
    lines = [(i, line) for i, line in lines if line.strip()]
    data = [(i, line) for i, line in lines if not line.startswith(_COMMENTS)]
    begin = data[0][0] if data else math.inf
    above = [line for i, line in lines if i < begin]
    separator = _separator([line for _, line in data[: 1 + _LOOKED_AT]])
    rows = [Row(i, _split(line, separator, columns)) for i, line in data]
    header: tuple[str, ...] = ()
    if rows and not any(_is_value(cell) for cell in rows[0].cells):
        header = tuple(rows.pop(0).cells)
        above = [data[0][1]]
    if rows and above:
        width = len(rows[0].cells)
        words = (_split(above[-1].lstrip("#% "), s, columns) for s in (separator, *_SEPARATORS))
        header = next((tuple(names) for names in words if len(names) == width), header)
    _drop_empty_end(rows, len(header))
    comments = tuple(line.lstrip("#% ") for _, line in lines if line.startswith(_COMMENTS))
    return Table(path, header, tuple(rows), comments, error, bool(text) and not text.endswith(("\n", "\r")))


def _check_counts(text: str, path: Path, error: type[EdgeSlamError]) -> None:
    if max(text.count("\n"), text.count("\r")) > MAX_LINES:
        raise error(f"{path}: more than {MAX_LINES} lines of a text table are not read")
    if sum(text.count(separator) for separator in _SEPARATORS) > MAX_CELLS:
        raise error(f"{path}: more than {MAX_CELLS} cells of a text table are not read")


def _encoding(data: bytes) -> str:
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    start = data[:256]
    zeros = [start[i::2].count(0) for i in (0, 1)]
    if len(start) >= 4 and max(zeros) > len(start) // 4 and min(zeros) == 0:
        return "utf-16-be" if zeros[0] > zeros[1] else "utf-16-le"
    return "utf-8-sig"


def _is_value(cell: str) -> bool:
    """Whether a cell is one of data rather than a name: it begins as a number or a date does."""
    return number(cell) is not None or bool(re.match(r"[+-]?[.,]?\d", cell))


def _separator(lines: Sequence[str]) -> str | None:
    """The separator of most lines; None where any will do, since all is numbers.

    Args:
        lines: Of the table, the first of which may be its header.
    """
    rows_alone = lines[1:] or lines
    decimal_comma = _has_decimal_comma(rows_alone)
    if not decimal_comma and rows_alone and all(_all_numbers(line) for line in rows_alone):
        return None
    fits = {}
    for separator in _SEPARATORS:
        rows = [_cells(line, separator) for line in lines if separator != "," or not decimal_comma]
        rows = [row for row in rows if len(row) > 1]
        same_width = max(Counter(len(row) for row in rows).values(), default=0)
        fits[separator] = (sum(number(row[0]) is not None for row in rows), same_width)
    best = max(fits, key=lambda separator: fits[separator])  # the first one of equals
    return best if fits[best][1] else _BLANKS


def _has_decimal_comma(lines: Sequence[str]) -> bool:
    """Whether commas stand inside numbers: other separators leave first cells such as ``1305031102,175``."""
    if any(re.search(r",\s|,,|,$", line) for line in lines):
        return False
    for separator in ("\t", ";", _BLANKS):
        cells = [_cells(line, separator) for line in lines]
        if all(len(row) > 1 and row[0].count(",") <= 1 for row in cells):
            found = [row for row in cells if _DECIMAL_COMMA.fullmatch(row[0])]
            elsewhere = any(_DECIMAL_COMMA.fullmatch(cell) for row in cells for cell in row[1:])
            plain = all(number(row[0]) is not None for row in cells)
            return plain and (2 * len(found) > len(lines) or elsewhere)
    return False


def _all_numbers(line: str) -> bool:
    return all(number(cell) is not None and "," not in cell for cell in _mixed(line))


def _mixed(line: str) -> list[str]:
    line = line.split("#", 1)[0].strip()
    return _MIXED.split(line) if "," in line or ";" in line or "\t" in line else line.split()


def _split(line: str, separator: str | None, columns: int | None) -> list[str]:
    if separator is None:
        return _mixed(line)
    return _cells(line, separator, columns)


def _cells(line: str, separator: str, columns: int | None = None) -> list[str]:
    """Cells of a line, the last one with all that is left when there are ``columns``."""
    if '"' in line and separator != _BLANKS:
        try:
            return [cell.strip() for cell in next(csv.reader([line], delimiter=separator, skipinitialspace=True))]
        except (csv.Error, StopIteration):
            pass
    most = -1 if columns is None else columns - 1
    parts = line.split(maxsplit=most) if separator == _BLANKS else line.split(separator, most)
    return [cell.strip().strip("\"'") for cell in parts]


def _drop_empty_end(rows: Sequence[Row], width: int) -> None:
    """Drop the empty cell that a separator at the end of each row makes."""
    if rows and all(len(row.cells) > max(width, 1) and not row.cells[-1] for row in rows):
        for row in rows:
            row.cells.pop()
