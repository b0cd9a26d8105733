import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edgeslam_torch.drone.sdk_state import parse_state, sample_from_sdk
from edgeslam_torch.readers.telemetry_csv import (
    HEADER,
    TelemetryError,
    TelemetryWriter,
    detect_units,
    read_table,
    read_telemetry,
)

REAL = (
    "mid:-1;x:0;y:0;z:0;mpry:0,0,0;pitch:3;roll:-1;yaw:0;vgx:0;vgy:0;vgz:0;templ:50;temph:54;tof:10;h:0;bat:51;"
    "baro:147.94;time:0;agx:54.00;agy:28.00;agz:-1004.00;\r\n"
)


def write(tmp_path, text):
    path = tmp_path / "telemetry.csv"
    path.write_text(text)
    return path


def test_a_real_state_line_is_parsed():
    fields = parse_state(REAL.encode())
    assert fields["agz"] == -1004.0
    assert fields["mpry"] == "0,0,0"
    sample = sample_from_sdk(5.0, fields)
    assert sample.battery == pytest.approx(0.51)
    assert sample.baro_m == pytest.approx(147.94)
    fields |= {"vgx": 5.0, "vgy": -2.0, "vgz": 1.0}
    np.testing.assert_allclose(sample_from_sdk(0.0, fields).velocity_m_s, [0.5, 0.2, -0.1])  # SDK: right and down
    assert sample.acceleration_m_s2[2] == pytest.approx(9.846, abs=1e-3)  # specific force points up when level
    np.testing.assert_allclose(np.degrees(sample.rpy_rad), [-1.0, -3.0, 0.0])


@pytest.mark.parametrize(
    "packet",
    [b"", b"\xff\xfe\x00", b"vgx:;bat:nan;tof:inf;yaw:1_0", b"tof:6553;bat:300;vgx:1000000;vgy:0;vgz:0"],
)
def test_what_no_tello_gives_is_missing(packet):
    sample = sample_from_sdk(0.0, parse_state(packet))
    assert np.isnan([sample.velocity_m_s[0], sample.tof_m, sample.battery]).all()


def test_what_is_written_is_read_back_and_a_row_cut_by_a_crash_costs_only_itself(tmp_path):
    path = tmp_path / "telemetry.csv"
    fields = parse_state(REAL)
    with TelemetryWriter(path) as writer:
        writer.write(12.5, fields)
        writer.write(12.6, {**fields, "vgx": 4.0, "tof": "soon"})
    assert path.read_text().splitlines()[0] == ",".join(HEADER)
    first, second = read_telemetry(path)[0]
    assert first.stamp_s == 12.5
    assert second.velocity_m_s[0] == pytest.approx(0.4)
    assert math.isnan(second.tof_m)
    with path.open("a") as file:
        file.write("12.7,3")  # the power went
    with TelemetryWriter(path) as writer:
        writer.write(12.8, fields)
    table = read_table(path)
    np.testing.assert_array_equal(table.stamps_s, [12.5, 12.6, 12.8])
    assert table.skipped == 1


def test_rows_without_order_or_numbers_are_skipped_and_counted(tmp_path):
    rows = "1,1,90,5\n1,2,90,5\nx,3,90,5\n2,,90,5\n0.5,4,90,5\n3,5\n\n# note\n1e300,7,90,5\n4,6,90,5\n"
    table = read_table(write(tmp_path, f"stamp_s,vgx,bat,vgx\n{rows}"))
    np.testing.assert_array_equal(table.stamps_s, [1.0, 2.0, 4.0])
    assert table.skipped == 5
    np.testing.assert_array_equal(table.values["vgx"][1:], [np.nan, 6.0])  # the first column of the name


@pytest.mark.parametrize(("clock", "unit_s"), [("time_us", 1e-6), ("stamp_ns", 1e-9), ("t (ms)", 1e-3), ("ts_s", 1.0)])
def test_any_clock_may_state_its_unit(tmp_path, clock, unit_s):
    rows = [f"{round(i / 10 / unit_s)},1\n" for i in range(0, 400, 10)]
    table = read_table(write(tmp_path, f"{clock},vgx\n" + "".join(rows)))
    np.testing.assert_allclose(table.stamps_s, np.arange(40.0))


@pytest.mark.parametrize(
    "content",
    ["a,b\n1,2\n", "stamp_s,colour\n1,2\n", "stamp_s,tof (furlong)\n0,1\n", "stamp_s,yaw\n" + 160 * "noon,1\n"],
)
def test_tables_that_are_no_telemetry_are_refused_in_one_line(tmp_path, content):
    path = write(tmp_path, content)
    with pytest.raises(TelemetryError) as caught:
        read_telemetry(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def climbing(tmp_path, velocity_unit, sign):
    """A log whose drone climbs and sinks by half a metre."""
    lines = ["timestamp,vx,vy,vz,tof"]
    for k in range(300):
        t = 0.1 * k
        z, v = 1.0 + 0.5 * math.sin(0.8 * t), 0.4 * math.cos(0.8 * t)
        lines.append(f"{1000 * t:.0f},0,0,{round(sign * v / velocity_unit, 3)},{round(100 * z)}")
    return write(tmp_path, "\n".join(lines) + "\n")


@pytest.mark.parametrize("velocity_unit", [0.1, 0.01, 1.0])
@pytest.mark.parametrize("sign", [-1, 1])
def test_unit_and_axis_of_the_velocity_are_found_from_height(tmp_path, velocity_unit, sign):
    table = read_table(climbing(tmp_path, velocity_unit, sign))
    units = detect_units(table)
    assert units.velocity_m_s == velocity_unit
    assert units.z_down == (sign < 0)
    samples = table.samples(units)
    assert samples[0].velocity_m_s[2] == pytest.approx(0.4, abs=0.01)
    assert samples[1].stamp_s == pytest.approx(0.1)  # milliseconds, told by their spacing


def date_of(ms):
    return f"2024-05-01 12:{int(ms) // 60000:02d}:{int(ms) % 60000 / 1e3:06.3f}"


def lowered(k, row):
    """Furniture under the drone shortens the range, not the flight."""
    return [*row[:4], str(int(row[4]) - (45 if 40 < k % 100 < 70 else 0))]


def gappy(k, row):
    return [*row[:3], "" if k % 7 == 0 else row[3], "None" if k % 5 == 0 else row[4]]


REWRITTEN = {
    "other order": ("tof,vz,timestamp,vy,vx", lambda k, r: [r[i] for i in (4, 3, 0, 2, 1)]),
    "quoted, separator at the end": ('"timestamp","vx","vy","vz","tof"', lambda k, r: [*(f'"{c}"' for c in r), ""]),
    "dates": ("timestamp,vx,vy,vz,tof", lambda k, r: [date_of(r[0]), *r[1:]]),
    "motor time beside the clock": ("time,timestamp,vx,vy,vz,tof", lambda k, r: [str(int(r[0]) // 1000), *r]),
    "no horizontal velocity, index in front": (",timestamp,vz,tof", lambda k, r: [str(k), r[0], *r[3:]]),
    "h in place of tof, some missing": ("timestamp,vx,vy,vz,height_cm", gappy),
    "furniture below": ("timestamp,vx,vy,vz,tof", lowered),
    "semicolons, units in names": ("Timestamp [ms];vgx (dm/s);vgy (dm/s);vgz (dm/s);ToF (cm)", lambda k, r: r),
    "Windows line ends and a byte order mark": ("\ufefftimestamp,vx,vy,vz,tof", lambda k, r: r),
}
"""Header and rows of the climbing flight as other programs might log it."""


@pytest.mark.parametrize("how", REWRITTEN)
def test_a_flight_that_another_program_logged_is_read_the_same(tmp_path, how):
    rows = [line.split(",") for line in climbing(tmp_path, 0.1, -1).read_text().splitlines()[1:]]
    header, change = REWRITTEN[how]
    separator, end = ";" if ";" in header else ",", "\r\n" if "\ufeff" in header else "\n"
    lines = [header, *(separator.join(change(k, row)) for k, row in enumerate(rows))]
    table = read_table(write(tmp_path, end.join(lines)))
    assert (len(table.stamps_s), table.skipped) == (300, 0)
    assert np.diff(table.stamps_s) == pytest.approx(np.full(299, 0.1), abs=1e-3)
    units = detect_units(table)
    assert (units.velocity_m_s, units.z_down, units.body_frame) == (0.1, True, False)
    sample = table.samples(units)[1]
    assert sample.velocity_m_s[2] == pytest.approx(0.4 * math.cos(0.08), abs=0.01)
    assert (sample.height_m if how.startswith("h in") else sample.tof_m) == pytest.approx(1.04, abs=0.011)


ODD = st.sampled_from(["", "-", "1e999", "nan", "0x10", "1_0", "６", " 5 ", '"', "None"])
cells = st.one_of(st.floats(allow_nan=True, allow_infinity=True).map(str), ODD, st.text(max_size=6))
lines = st.one_of(st.lists(cells, max_size=16).map(",".join), st.just(",".join(HEADER)), st.text(max_size=60))
TABLES = st.lists(lines, max_size=6).map(lambda rows: "\n".join([",".join(HEADER), *rows]))


@given(st.one_of(TABLES.map(lambda text: text.encode("utf-8", "surrogatepass")), st.binary(max_size=300)))
def test_anything_is_read_or_refused(tmp_path, data):
    path = tmp_path / "fuzz.csv"
    path.write_bytes(data)
    try:
        stamps = [s.stamp_s for s in read_telemetry(path)[0]]
    except TelemetryError as error:
        assert "\n" not in str(error)
    else:
        assert all(b > a for a, b in pairwise(stamps))


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([f"{0.1 * k:.1f},1,2,3,0,0,{k}" for k in range(5)], []),
        ([], ["no state message"]),
        (["0.0,1,2,3,0,0,0", "torn", "0.1,1,2,3,0,0,0", "0.1,1,2,3,0,0,0"], ["2 of 4 rows"]),
        (["0.0,,,,0,0,0", "0.1,,,,0,0,0"], ["vgx, vgy, vgz"]),
        (["0.0,1,2,3,,,0", "0.1,1,2,3,,,0"], ["pitch, roll, yaw"]),
    ],
)
def test_what_a_file_does_not_hold_is_said(tmp_path, rows, words):
    path = write(tmp_path, "\n".join(["stamp_s,vgx,vgy,vgz,pitch,roll,yaw", *rows]) + "\n")
    said = read_table(path).warnings("t.csv")
    assert len(said) == len(words) and all(word in line for word, line in zip(words, said, strict=True))


@pytest.mark.parametrize(
    ("header", "cell", "field", "expected"),
    [
        ("tof (m)", "1.2", "tof_m", 1.2),
        ("tof_mm", "1200", "tof_m", 1.2),
        ("h [ft]", "10", "height_m", 3.048),
        ("baro (cm)", "150", "baro_m", 1.5),
        ("tof", "120cm", "tof_m", 1.2),
        ("tof", "1,2 m", "tof_m", 1.2),
        ("bat (%)", "87 %", "battery", 0.87),
    ],
)
def test_units_of_header_and_cells_are_read(tmp_path, header, cell, field, expected):
    path = write(tmp_path, f"stamp_s;{header};yaw\n0,0;{cell};1\n0,1;{cell};1\n")
    assert getattr(read_telemetry(path)[0][1], field) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("times", "seconds", "skipped"),
    [
        (["12:00:00.0", "09:00:00.1", "09:00:00.2", "09:00:00.3"], 0.1, 1),  # set back by three hours
        (["100.0", "100.1", "1e15", "100.2"], 0.1, 1),  # one wild stamp
        (["4294967000", "4294967100", "4294967200", "4", "104"], 0.1, 0),  # 2**32 ms
        (["23:59:59.8", "23:59:59.9", "00:00:00.0", "00:00:00.1"], 0.1, 0),
        (['"2024-05-01, 12:00:00.0"', '"2024-05-01, 12:00:00.5"', '"2024-05-01, 12:00:01.0"'], 0.5, 0),
        (["01.05.2024 12:00:00.0", "01.05.2024 12:00:00.5", "01.05.2024 12:00:01.0"], 0.5, 0),
    ],
)
def test_clocks_that_begin_anew_and_dates_are_read_and_wild_ones_cost_a_row(tmp_path, times, seconds, skipped):
    table = read_table(write(tmp_path, "timestamp,yaw\n" + "".join(f"{t},1\n" for t in times)))
    np.testing.assert_allclose(np.diff(table.stamps_s), seconds, atol=0.005)
    assert (len(table.stamps_s), table.skipped) == (len(times) - skipped, skipped)


@pytest.mark.parametrize(
    "head",
    [
        b"ULog\x01\x125\x01",
        b"\xa3\x95\x80\x80",
        b"FMT, 128, 89, FMT, BBnNZ, Type,Length\n",
        b"1\n00:00:00,000 --> 00:00:00,033\n<font>HOME</font>\n",
        b"time(millisecond),datetime(utc),height_above_takeoff(feet),xSpeed(mph)\n0,1,2,3\n",
        b"latitude,longitude,altitude(m),velocityX(mps),pitchRaw\n1,2,3,4,5\n",
    ],
)
def test_logs_of_other_programs_are_refused_with_a_way_to_convert_them(tmp_path, head):
    path = tmp_path / "flight.log"
    path.write_bytes(head)
    with pytest.raises(TelemetryError, match="stamp_s"):
        read_telemetry(path)


@pytest.mark.parametrize(
    ("header", "value", "said"),
    [
        ("vgx", 3, ""),
        ("vgx", 0.3, "unit"),
        ("vgx (m/s)", 0.3, ""),
        ("yaw", 0.05, "unit"),
        ("yaw_rad", 0.05, ""),
        ("tof", "n/a", "'tof' holds no number"),
    ],
)
def test_implausible_and_missing_numbers_are_reported(tmp_path, header, value, said):
    path = write(tmp_path, f"stamp_s,{header},roll\n" + "".join(f"{i / 10},{value},9\n" for i in range(40)))
    warnings = [warning for warning in read_telemetry(path)[1] if "unit" in warning or "no number" in warning]
    assert len(warnings) == bool(said) and all(said in warning for warning in warnings)


@pytest.mark.filterwarnings("error")
def test_a_constant_height_determines_no_unit(tmp_path):
    rows = [f"{100 * k},0,0,{2 + k % 3},100" for k in range(100)]
    table = read_table(write(tmp_path, "\n".join(["timestamp,vx,vy,vz,tof", *rows]) + "\n"))
    assert "too little vertical motion" in detect_units(table).evidence


@pytest.mark.data
@pytest.mark.parametrize(("name", "count", "seconds"), [("flight_a", 2498, 253), ("flight_b", 2711, 275)])
def test_real_flights_are_read_with_their_clock_and_units(data_dir, name, count, seconds):
    table = read_table(data_dir / "tello_telemetry" / f"{name}.csv")
    assert (len(table.stamps_s), table.skipped) == (count, 0)
    assert table.stamps_s[-1] - table.stamps_s[0] == pytest.approx(seconds, abs=1.0)
    units = detect_units(table)
    assert (units.velocity_m_s, units.z_down) == (0.1, True)
    samples = table.samples(units)
    assert all(0.0 < s.battery <= 1.0 for s in samples)


def test_stamps_in_another_unit_than_their_name_are_reported(tmp_path):
    rows = "".join(f"{100 * k},{k}\n" for k in range(20))
    samples, said = read_telemetry(write(tmp_path, f"stamp_s,yaw\n{rows}"))
    assert samples[-1].stamp_s == pytest.approx(1.9)
    assert any("milliseconds" in warning for warning in said)
