"""A ROS 1 bag with one camera, byte by byte after http://wiki.ros.org/Bags/Format/2.0: no library's idea of it."""

import struct

DEFINITION = """Header header
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data
================================================================================
MSG: std_msgs/Header
uint32 seq
time stamp
string frame_id
"""


def _fields(**fields):
    """``name=value`` with their lengths before them."""
    parts = [name.encode() + b"=" + value for name, value in fields.items()]
    return b"".join(struct.pack("<I", len(part)) + part for part in parts)


def _record(data, **header):
    head = _fields(**header)
    return struct.pack("<I", len(head)) + head + struct.pack("<I", len(data)) + data


def _time(t):
    return struct.pack("<II", *divmod(round(t * 1e9), 10**9))


def _string(text):
    return struct.pack("<I", len(text)) + text


def _image(seq, t, width, height, encoding, pixels):
    head = struct.pack("<I", seq) + _time(t) + _string(b"camera")
    size = struct.pack("<II", height, width)
    return head + size + _string(encoding) + struct.pack("<BI", 0, len(pixels) // height) + _string(pixels)


def ros1_bag(topic, stamps_s, pictures, width, height):
    """A bag of rgb8 pictures in one chunk, received when they were stamped."""
    name, u32 = topic.encode(), struct.Struct("<I").pack
    about = _fields(
        topic=name,
        type=b"sensor_msgs/Image",
        md5sum=b"060021388200f6f0f447d0fcd9c64743",
        message_definition=DEFINITION.encode(),
    )
    connection = _record(about, op=b"\x07", conn=u32(0), topic=name)
    chunk, index = connection, b""
    for i, (t, pixels) in enumerate(zip(stamps_s, pictures, strict=True)):
        index += _time(t) + u32(len(chunk))
        chunk += _record(_image(i, t, width, height, b"rgb8", pixels), op=b"\x02", conn=u32(0), time=_time(t))
    count = u32(len(stamps_s))
    begin = b"#ROSBAG V2.0\n"
    chunk_at = len(begin) + 4096
    body = _record(chunk, op=b"\x05", compression=b"none", size=u32(len(chunk)))
    body += _record(index, op=b"\x04", ver=u32(1), conn=u32(0), count=count)
    info = {"ver": u32(1), "chunk_pos": struct.pack("<Q", chunk_at), "count": u32(1)}
    end = connection + _record(
        u32(0) + count, op=b"\x06", start_time=_time(stamps_s[0]), end_time=_time(stamps_s[-1]), **info
    )
    head = _fields(op=b"\x03", index_pos=struct.pack("<Q", chunk_at + len(body)), conn_count=u32(1), chunk_count=u32(1))
    padding = b" " * (4096 - 8 - len(head))
    return begin + u32(len(head)) + head + u32(len(padding)) + padding + body + end
