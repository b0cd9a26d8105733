"""Detection of other programs' flight logs, with instructions for their conversion."""

import re
from pathlib import Path

from edgeslam_torch.files.plain import open_plain

_HEAD_BYTES = 4096
_NEEDED = "columns stamp_s, 'vgx (m/s)', 'vgy (m/s)', 'vgz (m/s)', 'pitch (deg)', 'roll (deg)', 'yaw (deg)', 'tof (m)'"
_BINARY = (
    (b"ULog", "a ULog of PX4: convert it with 'ulog2csv FILE' (pyulog)", "vehicle_local_position and vehicle_attitude"),
    (
        b"\xa3\x95",
        "a DataFlash log of ArduPilot: convert it with 'mavlogdump.py --format csv --types XKF1 FILE' (pymavlink)",
        "XKF1 (VN, VE, VD, Roll, Pitch, Yaw)",
    ),
    (
        b"FMT, ",
        "a DataFlash log of ArduPilot as text: take the rows that begin with XKF1",
        "XKF1 (VN, VE, VD, Roll, Pitch, Yaw)",
    ),
)
_HEADERS = (
    (re.compile(r"height_above_takeoff|xspeed ?\(", re.I), "an AirData log: its positions are by GPS; convert its"),
    (re.compile(r"pitchraw|velocityx ?\(|gimbalpitchraw", re.I), "a Litchi log: convert its"),
    (re.compile(r"osd\.(?:xspeed|pitch)|custom\.updatetime", re.I), "a DJI flight record: convert its"),
)
_SRT = re.compile(r"^\ufeff?\s*1\s+\d{2}:\d{2}:\d{2},\d{3} --> ")
_MAVLINK = re.compile(rb"^.{8}[\xfe\xfd]", re.S)


def foreign_log(path: Path) -> str | None:
    """Kind of a foreign log and how to convert it, in one line; None for other files."""
    try:
        with open_plain(path) as file:
            head = file.read(_HEAD_BYTES)
    except OSError:
        return None
    for magic, what, where in _BINARY:
        if head.startswith(magic):
            return f"{what}, and make a table of {where} with the {_NEEDED}"
    if path.suffix.lower() == ".tlog" and _MAVLINK.match(head):
        what = "a MAVLink log: convert it with 'mavlogdump.py --format csv --types LOCAL_POSITION_NED FILE' (pymavlink)"
        return f"{what}, and make a table with the {_NEEDED}"
    text = head.decode("utf-16" if head[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8", errors="replace")
    if _SRT.match(text):
        return f"subtitles of a DJI video (SRT): they hold no velocities at this rate; make a table with the {_NEEDED}"
    first = text.lstrip("\ufeff").split("\n", 1)[0]
    found = next((what for pattern, what in _HEADERS if pattern.search(first)), None)
    return None if found is None else f"{found} velocities, attitude and height to a table with the {_NEEDED}"
