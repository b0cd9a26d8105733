import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edgeslam_torch.errors import SourceError
from edgeslam_torch.files import tables
from edgeslam_torch.files.tables import number, read_table
from edgeslam_torch.files.time_units import UNKNOWN, seconds_of

ROWS = [[1305031102.175, 1.5, -2.0], [1305031102.21, 0.25, 3.0]]


def written(tmp_path, text, encoding="utf-8"):
    path = tmp_path / "table.txt"
    path.write_bytes(text.encode(encoding))
    return path


@given(
    st.sampled_from([" ", "\t", ",", ";", ", ", " \t ", "; "]),
    st.sampled_from(["", "# t x y\n", "t{0}x{0}y\n", "#t{0}x{0}y\n"]),
    st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "utf-16-le"]),
    st.sampled_from(["\n", "\r\n", "\r"]),
)
def test_numbers_are_read_whatever_the_separator_header_and_encoding(tmp_path, separator, header, encoding, end):
    lines = [separator.join(map(str, row)) for row in ROWS]
    text = (header.format(separator) + "\n".join(lines) + "\n").replace("\n", end)
    table = read_table(written(tmp_path, text, encoding), SourceError)
    assert table.numbers().tolist() == ROWS
    assert table.header == (("t", "x", "y") if header else ())


@pytest.mark.parametrize(("end", "limit"), [("\n", "LINES"), ("\r", "LINES"), ("\r\n", "LINES"), (" ", "CELLS")])
def test_a_small_file_of_very_many_lines_or_cells_is_refused(tmp_path, end, limit, monkeypatch):
    monkeypatch.setattr(tables, f"MAX_{limit}", 1000)
    with pytest.raises(SourceError, match=limit.lower()):
        read_table(written(tmp_path, f"1{end}" * 1001), SourceError)
    assert read_table(written(tmp_path, f"1{end}" * 1000), SourceError).numbers().size == 1000


@pytest.mark.parametrize("separator", [" ", "\t", ";", "; "])
@pytest.mark.parametrize("quote", ["", '"'])
def test_decimal_commas(tmp_path, separator, quote):
    if quote and separator == " ":
        pytest.skip("quotes are of spreadsheets")
    lines = [separator.join(f"{quote}{x}{quote}".replace(".", ",") for x in row) for row in ROWS]
    assert read_table(written(tmp_path, "\n".join(lines)), SourceError).numbers().tolist() == ROWS
    table = read_table(written(tmp_path, "\n".join(f"{line}{separator}rgb/a.png" for line in lines)), SourceError)
    assert table.numbers([0, 1, 2]).tolist() == ROWS
    assert [row.cells[3] for row in table.rows] == ["rgb/a.png"] * 2


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"t x\n1 2\n1 a\n", "line 3, column 2 (x)"),
        (b"1 2\n1 2 3\n", "line 2"),
        ("1 2\n3 ü\n".encode("latin-1"), "UTF-8"),
        (b"\x00\x01\x02\x03\x00\x00\x00\x00", "not a text file"),
    ],
)
def test_errors_name_the_place(tmp_path, content, words):
    path = tmp_path / "table.txt"
    path.write_bytes(content)
    with pytest.raises(SourceError, match="table.txt") as caught:
        read_table(path, SourceError).numbers()
    assert words in str(caught.value)


def test_an_incomplete_last_row_is_left_out_and_size_is_bounded(tmp_path):
    path = written(tmp_path, "1 2 3\n4 5 6\n7 8")
    assert len(read_table(path, SourceError).numbers()) == 2
    with pytest.raises(SourceError, match="line 3 has 2 columns"):
        read_table(written(tmp_path, "1 2 3\n4 5 6\n7 8\n"), SourceError).numbers()
    with pytest.raises(SourceError, match="MB"):
        read_table(path, SourceError, max_bytes=5)


@pytest.mark.parametrize("factor,unit", [(1.0, "s"), (1e3, "ms"), (1e6, "us"), (1e9, "ns")])
@pytest.mark.parametrize("begin_s", [0.0, 328551.5, 1305031102.0])
@pytest.mark.parametrize("gap_s", [1 / 120, 1 / 30, 0.1])
def test_unit_of_stamps_since_boot_start_and_1970(factor, unit, begin_s, gap_s):
    if unit == "ms" and gap_s < 0.01 and begin_s < 1e9:
        pytest.skip("8 s or 8 ms: the first plausible unit")
    stamps = np.round((begin_s + gap_s * np.arange(20)) * factor, 6)
    seconds, found = seconds_of(stamps)
    assert found == unit
    assert np.allclose(np.diff(seconds), gap_s, rtol=0.2)


def test_units_at_their_limits():
    assert seconds_of([0, 60, 120])[1] == "ms"
    assert seconds_of([0.0, 1e-5])[1] == UNKNOWN
    assert seconds_of([1.4e18])[1] == "ns"
    assert seconds_of([])[1] == "s"
    assert seconds_of([5.0, np.nan, 5.0, 1e154])[1] == UNKNOWN


@pytest.mark.parametrize(
    ("text", "rows"),
    [
        ("recording,settings\na.mp4,x=1;y=2\n", [["a.mp4", "x=1;y=2"]]),  # the separator is that of the header
        ("a,b\n1,2,\n3,4,\n", [["1", "2"], ["3", "4"]]),  # one at the end of each row adds no column
        ("a,b,c\n1,2,\n3,4,\n", [["1", "2", ""], ["3", "4", ""]]),
    ],
)
def test_cells_are_parted_as_the_header_says(tmp_path, text, rows):
    assert [row.cells for row in read_table(written(tmp_path, text), SourceError).rows] == rows
    quoted = written(tmp_path, '"t","x"\n"1,5","2,25"\n"2,5","3"\n')
    assert read_table(quoted, SourceError).numbers().tolist() == [[1.5, 2.25], [2.5, 3.0]]


def test_what_is_no_number():
    assert [number(text) for text in ("", "1_000", "12cm", "1.000,5", "1,2,3", ",", "x")] == [None] * 7
