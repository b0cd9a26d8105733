"""List, download, convert and inspect depth-network weights."""

import argparse
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from edgeslam_torch.errors import ConfigError
from edgeslam_torch.files.output_file import check_new, output_file
from edgeslam_torch.models.record import weights_file

if TYPE_CHECKING:
    from onnx import ModelProto

    from edgeslam_torch.models.download import Fetched
    from edgeslam_torch.models.onnx.external import ExternalNetwork
    from edgeslam_torch.models.record import Metadata


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="list|download|convert|inspect")
    actions.add_parser("list", help="shipped, downloaded and downloadable weights")
    download = actions.add_parser("download", help="fetch official FastDepth weights, or a network of others")
    download.add_argument("name", help="as 'list' prints it")
    download.add_argument("--out", "-o", type=output_file, help="where to put the file (default: the cache)")
    download.add_argument(
        "--sha256", type=_sha256, help="expected SHA-256 of the download (default: that of the first download)"
    )
    convert = actions.add_parser("convert", help="convert an official .pth.tar to .safetensors without executing it")
    convert.add_argument("checkpoint", type=Path)
    convert.add_argument("--out", "-o", type=output_file, required=True)
    inspect = actions.add_parser("inspect", help="print the metadata of a weights file")
    inspect.add_argument(
        "weights",
        nargs="?",
        type=weights_file,
        help=".safetensors, .pt or .onnx, or 'default' or 'near' (default: default)",
    )


def main(args: argparse.Namespace) -> int:
    """Run one of the four subcommands."""
    {"list": _list, "download": _download, "convert": _convert, "inspect": _inspect}[args.action](args)
    return 0


def _list(_: argparse.Namespace) -> None:
    from edgeslam_torch.files.user_cache import cache_folder
    from edgeslam_torch.models.download import REMOTES
    from edgeslam_torch.models.onnx.presets import PRESETS, preset_file
    from edgeslam_torch.models.record import SHIPPED_WEIGHTS
    from edgeslam_torch.models.weights_file import read_header

    for name, path in SHIPPED_WEIGHTS.items():
        print(f"{name}: {read_header(path).variant}\n    {path}")
    there = [(remote, cache_folder() / f"{remote.name}.safetensors") for remote in REMOTES.values()]
    there += [(preset.remote, preset_file(name)) for name, preset in PRESETS.items()]
    for remote, local in there:
        print(f"{remote.name}: {remote.about}; {remote.licence}")
        print(f"    {local if local.is_file() else 'not downloaded: ' + remote.urls[0]}")


def _download(args: argparse.Namespace) -> None:
    from edgeslam_torch.files.download import remember, remembered
    from edgeslam_torch.files.user_cache import cache_folder
    from edgeslam_torch.models.convert import convert_upstream
    from edgeslam_torch.models.download import REMOTES, download
    from edgeslam_torch.models.onnx.presets import PRESETS, preset_file
    from edgeslam_torch.terminal.progress import Progress

    if args.name in PRESETS:
        remote, suffix, raw = PRESETS[args.name].remote, ".onnx", preset_file(args.name)
    elif args.name in REMOTES:
        remote, suffix = REMOTES[args.name], ".safetensors"
        raw = cache_folder() / f"{remote.name}.pth.tar"
    else:
        raise ConfigError(f"no weights called {args.name!r}; there are {', '.join([*REMOTES, *PRESETS])}")
    if args.out is not None and args.name in PRESETS:  # the description is written beside the network
        check_new(args.out.with_suffix(".toml"), args.overwrite)
    before = remembered(raw)
    with Progress(remote.name, unit="MB") as progress:
        fetched = download(remote.urls, raw, args.sha256, progress.downloaded)
    target = args.out or cache_folder() / f"{remote.name}{suffix}"
    target.parent.mkdir(parents=True, exist_ok=True)
    if args.name in PRESETS:
        _describe(args.name, raw, target)
    else:
        convert_upstream(raw, target, official=True)
    kept = remember(raw, fetched.sha256)  # remember the checksum of valid files only
    print(f"{fetched.url}\nsha256 {fetched.sha256}, {_trust(args.sha256, before, fetched, kept)}")
    print(target)


def _describe(name: str, raw: Path, target: Path) -> None:
    """Put the network and its description in place, once it proves to be one."""
    import shutil

    from edgeslam_torch.files.atomic import write_atomically, write_text
    from edgeslam_torch.models.onnx.external import read_external

    write_text(raw.with_suffix(".toml"), f'preset = "{name}"\n')
    read_external(raw)
    if target != raw:
        with raw.open("rb") as content:
            write_atomically(target, lambda file: shutil.copyfileobj(content, file))
        write_text(target.with_suffix(".toml"), f'preset = "{name}"\n')


def _trust(given: str | None, before: str | None, fetched: "Fetched", kept: Path) -> str:
    """How far the file's origin is verified."""
    if given is not None:
        return "as you gave it"
    if before is not None:
        return "the same as at the first download"
    how = "" if fetched.encrypted else ", and it came unencrypted: it may have been changed on the way"
    return f"trusted on first use: its publisher states no checksum{how}; kept in {kept}, the next must match"


def _sha256(text: str) -> str:
    if len(text) != 64 or not set(text.lower()) <= set("0123456789abcdef"):
        raise argparse.ArgumentTypeError(f"must be 64 hexadecimal digits, got {text[:80]!r}")
    return text.lower()


def _convert(args: argparse.Namespace) -> None:
    from edgeslam_torch.models.convert import convert_upstream

    args.out.parent.mkdir(parents=True, exist_ok=True)
    metadata = convert_upstream(args.checkpoint, args.out)
    print(f"{args.out}: {metadata.variant}")


def _inspect(args: argparse.Namespace) -> None:
    from edgeslam_torch.models.checkpoint import file_hash
    from edgeslam_torch.models.record import DEFAULT_WEIGHTS

    path = args.weights or DEFAULT_WEIGHTS
    size, metadata = _size_and_record(path)
    print(f"{path}\nsha256 {file_hash(path)}{size}")
    for field in dataclasses.fields(metadata):
        print(f"{field.name}: {_printable(str(getattr(metadata, field.name)))}")


def _size_and_record(path: Path) -> "tuple[str, Metadata | ExternalNetwork]":
    if path.suffix == ".onnx":
        from edgeslam_torch.models.onnx.external import read_external
        from edgeslam_torch.models.onnx.file import parse_onnx, read_onnx

        file = parse_onnx(path)
        metadata = read_onnx(file)[1] if file.is_ours else read_external(file)[1]
        return _operations(file.model), metadata
    from edgeslam_torch.models.checkpoint import load_checkpoint
    from edgeslam_torch.models.complexity import measure_complexity

    network, metadata = load_checkpoint(path)
    # On the meta device: counting needs only shapes, whatever image size the record states.
    size = measure_complexity(network.to("meta"), metadata.input_height, metadata.input_width)
    return f"\n{size.parameters / 1e6:.2f} M parameters, {size.macs / 1e9:.2f} GMAC per image", metadata


def _operations(model: "ModelProto") -> str:
    """Multiply-accumulates of an ONNX file, on a line of their own; nothing where its size is open."""
    import onnx

    from edgeslam_torch.models.onnx.operations import count_operations

    try:
        count = count_operations(model)
    except (ValueError, onnx.shape_inference.InferenceError):
        return ""
    total = count.int8_macs + count.float_macs
    share = count.int8_macs / max(total, 1)
    return f"\n{total / 1e9:.2f} GMAC per image, {share:.0%} in int8; weights {count.weight_bytes / 1e6:.1f} MB"


def _printable(text: str) -> str:
    """Untrusted text without terminal control characters."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)
