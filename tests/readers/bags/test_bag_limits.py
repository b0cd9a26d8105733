"""Bags made to hang, to take memory or to run code; and formats that only look strange."""

import bz2
import os
import shutil
import sqlite3

import bag_files as bags
import numpy as np
import pytest

from edgeslam_torch.errors import SourceError
from edgeslam_torch.readers.bags import limits
from edgeslam_torch.readers.bags.limits import check_definition_text, check_message, check_types, chunk_bytes
from edgeslam_torch.readers.source import open_source

pytest.importorskip("rosbags")
pytest.importorskip("mcap_ros2")
IMAGE = "sensor_msgs/msg/Image"
BEGIN_S = 1.7e9


def _pictures(first, count):
    return bags.pictures([BEGIN_S + i / 30.0 for i in range(first, first + count)], late_s=0.0, first=first)


def _check_read(path, count):
    frames = list(open_source(path).frames())
    assert [round((frame.stamp_s - BEGIN_S) * 30) for frame in frames] == list(range(count))
    for i, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.image, bags.pixels(i))


@pytest.mark.parametrize("name", ["a#b.db3", "a%41?.db3", "a b.db3", "a.bag", "a#?.mcap"])
def test_names_with_characters_of_uris_are_read(tmp_path, name):
    if name.endswith(".db3"):
        bags.write_ros2(tmp_path / "made", _pictures(0, 3))
        shutil.copy(next((tmp_path / "made").glob("*.db3")), tmp_path / name)
    else:
        (bags.write_mcap if name.endswith("mcap") else bags.write_ros1)(tmp_path / name, _pictures(0, 3))
    _check_read(tmp_path / name, 3)


@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".db3"])
def test_a_split_recording_without_metadata_is_read_in_order(tmp_path, suffix):
    folder = tmp_path / "split"
    folder.mkdir()
    for part, name in enumerate(("x_9", "x_10")):  # names sort the other way round
        path = folder / (name + suffix)
        if suffix == ".db3":
            bags.write_ros2(tmp_path / name, _pictures(3 * part, 3))
            shutil.copy(next((tmp_path / name).glob("*.db3")), path)
        else:
            (bags.write_mcap if suffix == ".mcap" else bags.write_ros1)(path, _pictures(3 * part, 3))
    _check_read(folder, 6)
    (bags.write_ros1 if suffix == ".bag" else bags.write_mcap)(tmp_path / f"y{suffix}", _pictures(9000, 1))
    if suffix != ".db3":
        shutil.copy(tmp_path / f"y{suffix}", folder)
        with pytest.raises(SourceError, match="do not follow each other"):
            open_source(folder)


def _mcap_of_ros1(path, profile, count):
    from mcap.writer import CompressionType, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(profile, "test")
        definition = store.generate_msgdef(IMAGE)[0].encode()
        channel = writer.register_channel(
            "/cam/image_raw", "ros1", writer.register_schema(IMAGE, "ros1msg", definition)
        )
        for _, _, t, message in _pictures(0, count):
            data = store.serialize_ros1(bags._record(store, IMAGE, message), IMAGE)
            writer.add_message(channel, round(t * 1e9), bytes(data), round(t * 1e9))
        writer.finish()
    return path


@pytest.mark.parametrize("profile", ["ros1", "", "other"])
def test_mcap_of_ros1_or_without_a_profile_is_read(tmp_path, profile):
    _check_read(_mcap_of_ros1(tmp_path / "a.mcap", profile, 4), 4)


def _database(tmp_path):
    bags.write_ros2(tmp_path / "made", _pictures(0, 3))
    path = tmp_path / "a.db3"
    shutil.copy(next((tmp_path / "made").glob("*.db3")), path)
    return path, sqlite3.connect(path)


ENDLESS = "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n)"


@pytest.mark.parametrize(
    "sql",
    [
        f"DROP TABLE schema; CREATE VIEW schema AS {ENDLESS} SELECT max(x) AS schema_version FROM n",
        f"ALTER TABLE message_definitions RENAME TO d; CREATE VIEW message_definitions AS {ENDLESS} "
        "SELECT 'a' AS topic_type, 'b' AS encoding, 'c' AS encoded_message_definition, 'd' AS type_description_hash, "
        "max(x) AS id FROM n",
        "ALTER TABLE messages DROP COLUMN data; ALTER TABLE messages ADD COLUMN data AS (zeroblob(200000000))",
        "ALTER TABLE messages DROP COLUMN data; ALTER TABLE messages ADD COLUMN half AS (x'00' || x'00'); "
        "ALTER TABLE messages ADD COLUMN data AS (half || half)",
        "UPDATE topics SET name = x'00ff'",
        "UPDATE topics SET type = 5",
        "UPDATE topics SET name = x'00ff', type = x'00'",
        "UPDATE messages SET timestamp = 9e999",
        "UPDATE messages SET timestamp = 1e300 WHERE id > 1",
        "UPDATE messages SET timestamp = 'soon'",
        "UPDATE messages SET timestamp = x'00'",
        "UPDATE messages SET data = 'text'",
        "UPDATE messages SET data = 5",
        "UPDATE message_definitions SET encoded_message_definition = 'string[1000000000] a'",
        "UPDATE message_definitions SET encoded_message_definition = 'float32 X=1e999\n' || encoded_message_definition",
        "UPDATE message_definitions SET encoding = 'other'",
    ],
)
def test_a_database_with_views_and_wrong_types_ends_in_one_line(tmp_path, sql):
    path, connection = _database(tmp_path)
    connection.executescript(sql)
    connection.close()
    with pytest.raises(SourceError) as caught:
        list(open_source(path).frames())
    assert "\n" not in str(caught.value)


def test_decompression_stops_at_its_bound(monkeypatch):
    from lz4 import frame

    zstd = limits._zstd()
    monkeypatch.setattr(limits, "MAX_CHUNK_BYTES", 1 << 20)
    for size in (1 << 20, (1 << 20) + 1, 1 << 24):
        data = bytes(size)
        for name, packed in {
            "bz2": bz2.compress(data),
            "lz4": frame.compress(data),
            "zstd": zstd.compress(data),
        }.items():
            if size <= 1 << 20:
                assert chunk_bytes(name, packed) == data
                with pytest.raises((EOFError, RuntimeError)):
                    chunk_bytes(name, packed[:-3])
            else:
                with pytest.raises(SourceError, match="MiB"):
                    chunk_bytes(name, packed)


@pytest.mark.parametrize("form", ["bz2", "mcap", "mcap of ros1", "MESSAGE", "FILE"])
def test_what_grows_beyond_the_bound_is_refused_and_the_rest_is_read(tmp_path, monkeypatch, form):
    if form == "bz2":
        path = bags.write_ros1(tmp_path / "a.bag", _pictures(0, 3), packed=True)
    elif form == "mcap":
        path = bags.write_mcap(tmp_path / "a.mcap", _pictures(0, 3))
    elif form == "mcap of ros1":
        path = _mcap_of_ros1(tmp_path / "a.mcap", "ros1", 3)
    else:
        path = bags.write_ros2(tmp_path / "a", _pictures(0, 3), form)
    _check_read(path, 3)
    monkeypatch.setattr(limits, "MAX_CHUNK_BYTES", 9000)  # a picture has 9216 bytes
    monkeypatch.setattr(limits, "MAX_FILE_RATIO", 0)
    with pytest.raises(SourceError, match="is not read|too big"):
        list(open_source(path).frames())


@pytest.mark.parametrize(
    ("text", "idl"),
    [
        ("uint8 a\n" * 20_000, False),
        ("module a { const long X = 1 << 100000000000; };", True),
        ("module a { const long X = 9 * 9999999999; };", True),
        ("module a { const long X = 99999999999999999999999999; };", True),
    ],
)
def test_definitions_that_compute_or_never_end_are_refused(text, idl):
    with pytest.raises(SourceError, match="definition"):
        check_definition_text(text, "/x", idl)


def test_sizes_constants_and_names_of_messages_are_bounded_before_they_reach_the_compiler():
    from rosbags.typesys import get_types_from_msg

    sizes = [
        "string[1000000000] a",
        "geometry_msgs/Point[2000] a",
        "uint8[0] a",
        "uint8[100000000] a",
        "float32 X=1e999",
    ]
    names = ["a/msg/B:\n  import os", "a/msg/B'", "a b", "", "a//b", "é/msg/B"]
    types = [get_types_from_msg(definition, "a/msg/B") for definition in sizes]
    for name in names:
        types += [{name: ([], [])}, {"a/msg/B": ([(name, "int32", 1)], [])}]
        types += [{"a/msg/B": ([], [field])} for field in ((name, (1, ("uint8", 0))), ("x", (2, name)))]
        types += [{"a/msg/B": ([], [("x", (4, ((2, name), 0)))])}]
    for each in types:
        with pytest.raises(SourceError, match="/x"):
            check_types(each, "/x")


@pytest.mark.parametrize("listed", ["a/C[]", "string[]", "a/D"])
def test_lists_that_become_objects_are_refused_in_large_messages_alone(listed):
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    text = f"uint8[] data\n{listed} x\n{'=' * 80}\nMSG: a/C\nuint8 y\n{'=' * 80}\nMSG: a/D\na/C[2] y\n"
    types = get_types_from_msg(text, "a/msg/B")
    check_message(types, "a/msg/B", bytes(1000), "/x")
    with pytest.raises(SourceError, match="/x: a message of 5000000 bytes with a list of"):
        check_message(types, "a/msg/B", bytes(5_000_000), "/x")
    known = get_typestore(Stores.LATEST).fielddefs
    for kind in (IMAGE, "sensor_msgs/msg/CompressedImage", "nav_msgs/msg/Odometry"):
        check_message(known, kind, bytes(5_000_000), "/x")


@pytest.mark.timeout(20)
@pytest.mark.parametrize("name", ["b.db3", "b.mcap"])
def test_a_pipe_in_a_bags_folder_is_refused(tmp_path, name):
    bags.write_ros2(tmp_path / "bag", _pictures(0, 3))
    os.mkfifo(tmp_path / "bag" / name)
    with pytest.raises(SourceError, match="not a regular file"):
        open_source(tmp_path / "bag")


def test_sixteen_bits_of_a_thermal_camera_are_read_where_the_topic_is_named(tmp_path):
    data = (7000 + 100 * np.arange(48 * 64).reshape(48, 64) % 1500).astype(np.uint16)
    times = [BEGIN_S + i / 30 for i in range(3)]
    path = bags.write_mcap(tmp_path / "a.mcap", [("/t/image", IMAGE, t, bags.picture(t, data, "16UC1")) for t in times])
    with pytest.raises(SourceError, match="--topic /t/image"):
        open_source(path)
    source = open_source(path, topics=["/t/image"])
    image = next(iter(source.frames())).image
    assert image.dtype == np.uint8 and np.ptp(image.astype(int)) > 10
    assert any("16UC1" in problem.reason for problem in source.problems)


def _unfinished(tmp_path):
    whole = bags.write_ros1(tmp_path / "a.bag", _pictures(0, 1)).read_bytes()
    at = whole.index(b"index_pos=") + len(b"index_pos=")
    path = tmp_path / "a.bag.active"
    path.write_bytes(whole[:at] + bytes(8) + whole[at + 8 :])
    return path


def _cut_off(tmp_path):
    path = _mcap_of_ros1(tmp_path / "a.mcap", "ros1", 4)
    path.write_bytes(path.read_bytes()[:-200])
    return path


def _damaged(tmp_path):
    path = bags.write_ros2(tmp_path / "bag", _pictures(0, 20))
    database = next(path.glob("*.db3"))
    database.write_bytes(database.read_bytes()[:60_000])
    return path


@pytest.mark.parametrize(
    ("made", "remedy"),
    [
        (_unfinished, "rosbag reindex"),
        (_cut_off, "mcap recover"),
        (_damaged, r"damaged; repair it with: sqlite3 .* \.recover"),
    ],
)
def test_what_was_not_closed_is_refused_with_the_remedy(tmp_path, made, remedy):
    with pytest.raises(SourceError, match=remedy):
        list(open_source(made(tmp_path)).frames())
