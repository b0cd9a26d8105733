"""Topics of a ROS bag: types, counts, rates, and what ``edgeslam run`` would use each as."""

import argparse
from pathlib import Path

from edgeslam_torch.help.options import add_topic


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("bag", type=Path, metavar="FILE", help=".bag, .mcap or .db3 file, or folder of a ROS 2 bag")
    add_topic(parser, "as for 'edgeslam run': shows what this choice uses")


def main(args: argparse.Namespace) -> int:
    """Print the table."""
    from edgeslam_torch.errors import SourceError
    from edgeslam_torch.readers.bags.bag import Bag, is_bag
    from edgeslam_torch.readers.bags.topics import choose, depth_of, role_of

    path = args.bag.expanduser()
    if not path.exists():
        raise SourceError(f"{path}: no such file or folder")
    if not is_bag(path):
        raise SourceError(f"{path}: not a ROS bag (.bag, .mcap, .db3, or a folder of these)")
    bag = Bag(path)
    doubt = None
    used: dict[str, str] = {}
    remarks: tuple[str, ...] = ()
    try:
        choice = choose(bag, args.topic)
    except SourceError as error:
        if args.topic:
            raise
        doubt = str(error)
    else:
        used = dict.fromkeys(choice.imu, "imu") | {name: role for role, name in choice.telemetry.items()}
        used |= {choice.image: "image"}
        used |= {} if choice.camera is None else {choice.camera: "camera"}
        remarks = choice.remarks
    rows = [("topic", "type", "messages", "Hz", "used as")]
    for topic in bag.topics:
        rate = f"{(topic.count - 1) / bag.duration_s:.1f}" if topic.count > 1 and bag.duration_s > 0 else ""
        role = role_of(topic)
        what = used.get(topic.name, "")
        if not what and role is not None:
            form = depth_of(bag, topic) if role == "image" else None
            what = f"not used ({role if form is None else f'depth map, {form}'})"
        rows.append((topic.name, topic.kind, str(topic.count), rate, what))
    widths = [max(len(row[i]) for row in rows) for i in range(5)]
    print(f"{path.name}: {bag.duration_s:.1f} s, {sum(topic.count for topic in bag.topics)} messages")
    for name, kind, count, rate, what in rows:
        line = f"{name:<{widths[0]}}  {kind:<{widths[1]}}  {count:>{widths[2]}}  {rate:>{widths[3]}}  {what}"
        print(line.rstrip())
    for remark in (*remarks, *([doubt] if doubt else [])):
        print(f"note: {remark}")
    return 0
