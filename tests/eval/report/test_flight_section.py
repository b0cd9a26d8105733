"""The flight in the report: way, clearance and events of its own record; nothing where there is none."""

import pytest

from edgeslam_torch.eval.report.flight_section import flight_section

HEAD = "stamp_s,x_m,y_m,clearance_m,phase,danger,why\n"


def written(tmp_path, lines):
    (tmp_path / "moments.csv").write_text(HEAD + "".join(lines))
    return flight_section(tmp_path)


def test_way_clearance_and_each_change_of_state(tmp_path):
    lines = [f"{10 + 0.5 * k},{0.3 * k},0.4,{1.0 - 0.2 * k},flying,,along <the> way\n" for k in range(4)]
    lines.append("12.0,1.2,0.4,nan,flying,no fresh picture,hover\n")
    page = written(tmp_path, lines)
    assert "2 s, 1.2 m by its own map" in page and "than 0.40 m" in page
    assert page.count("<tr>") == 3, "the head, flying, and what ended it"
    assert "along &lt;the&gt; way" in page and "no fresh picture" in page
    assert page.count("<svg") == 2


def test_a_long_flight_says_how_many_changes_are_left_out(tmp_path):
    page = written(tmp_path, [f"{k},0,0,1,{('flying', 'turning')[k % 2]},,w\n" for k in range(70)])
    assert page.count("<tr>") == 1 + 60 and "and 10 more" in page


def test_exits_are_drawn_from_jamb_to_jamb(tmp_path):
    lines = [f"{k},{k}.0,0.0,1.0,flying,,w\n" for k in range(3)]
    without = written(tmp_path, lines)
    (tmp_path / "exits.csv").write_text("x_m,y_m,normal_x,normal_y,width_m\n2,0,1,0,0.9\n2,nan,1,0,0.9\n")
    page = written(tmp_path, lines)
    assert "1 exit found" in page and "0.9 m wide" in page and "exit" not in without
    assert page.count("<circle") == without.count("<circle") + 1


@pytest.mark.parametrize("lines", [[], ["soup\n"], ["1,nan,0,0,a,b,c\n", "2,0,0,0,a,b,c\n"]])
def test_no_flight_no_section(lines, tmp_path):
    assert written(tmp_path, lines) == ""
    assert flight_section(None) == "" == flight_section(tmp_path / "none")


def test_flight_without_clearance_shows_its_way(tmp_path):
    page = written(tmp_path, ["1,0,0,nan,a,,w\n", "2,3,4,nan,a,,w\n"])
    assert "5.0 m by its own map" in page and page.count("<svg") == 1
