"""Put a release's figures into the documents: ``python docs/building/results_pages.py``.

``docs/results/VERSION.json`` is what ``edgeslam judge --release`` wrote, ``ablation.json`` what ``edgeslam ablation``
did; figures of other systems are those of ``eval/benchmark/peers.toml``. What stands between ``<!-- results: NAME -->``
and ``<!-- end -->`` is replaced.
"""

import json
import re
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "docs" / "results"
ABLATION = RESULTS / "ablation.json"
PEERS = ROOT / "eval" / "benchmark" / "peers.toml"
BLOCK = re.compile(r"<!-- results: (\w+) -->(.*?)<!-- end -->", re.DOTALL)
_DOCUMENTS = (ROOT / "README.md", *sorted(ROOT.glob("docs/**/*.md")))
PAGES = tuple(page for page in _DOCUMENTS if BLOCK.search(page.read_text(encoding="utf-8")))

RECORDINGS = {
    "tum_fr1_xyz": "TUM fr1_xyz, desk",
    "7scenes_redkitchen": "7-Scenes redkitchen",
    "euroc_mh05_a": "EuRoC MH_05, drone",
    "tum_fr1_rpy_depth": "TUM fr1_rpy, turns",
    "fr3_notexture_a": "TUM fr3, bare boards",
    "hololens_a/perturbed": "HoloLens, big steps",
    "tartan_hospital/perturbed": "TartanAir hospital",
}
"""Runs of the release that are recordings, and their titles."""
FLIGHTS = {"flight/room": "room", "flight/corridor": "corridor", "flight/block": "once around a block"}
SHOWN = {"calibrate": slice(-9, None), "fly": slice(-3, None), "evaluate": slice(0, 14), "plan": slice(None)}
"""Lines of a command's output that documents show; the last five of others."""
Figures = dict[str, list[float]]


def newest() -> dict[str, Any]:
    """The latest release's record."""
    path = max(RESULTS.glob("[0-9]*.json"), key=lambda p: [int(n) for n in re.findall(r"\d+", p.stem)])
    return json.loads(path.read_text(encoding="utf-8"))


def blocks(release: dict[str, Any], ablation: dict[str, Any], peers: Sequence[dict[str, Any]]) -> dict[str, str]:
    """Text of every block by its name."""
    changed = {name: row["runs"] for name, row in ablation["rows"].items() if row["runs"]}
    outputs = {
        name: _block("\n".join(["```text", command, *lines[SHOWN.get(name, slice(-5, None))], "```"]))
        for name, (command, *lines) in release["outputs"].items()
    }
    runs = release["runs"]
    tables = {f"ablation_{name.replace('-', '_')}": _table(*_ablated(changed, name)) for name in changed}
    return (
        outputs
        | tables
        | {
            "conditions": _conditions(release),
            "summary": _table(
                ("", "ATE [m]", "map [cm]", "CPU [ORB]", "others: ATE [m], frames"), _summary(runs, peers)
            ),
            "accuracy": _table(_RECORDING_HEADER, [_accuracy(runs[name], title) for name, title in RECORDINGS.items()]),
            "map_and_cost": _table(
                _MAP_HEADER, [_map_and_cost(runs[name], title) for name, title in RECORDINGS.items()]
            ),
            "telemetry": _table(_SENSOR_HEADER, _with_sensor(runs, "telemetry/rounded")),
            "imu": _table(_SENSOR_HEADER, _with_sensor(runs, "imu/recorded")),
            "flights": _table(_FLIGHT_HEADER, [_flight(runs[name], title) for name, title in FLIGHTS.items()]),
            "peers": _block("\n\n".join(_peers(runs, peers))),
            "block_caption": _block_caption(runs["flight/block"]),
            "ablation_conditions": _ablation_conditions(ablation),
            "chance_caption": _chance_caption(runs["hololens_a/perturbed"]),
        }
    )


_RECORDING_HEADER = ["recording", "runs", "ATE [m]", "live [m]", "SE(3) [m]", "scale error", "stated sigma"]
_MAP_HEADER = [
    "recording",
    "frames",
    "on the map",
    "edge points",
    "to the surface [cm]",
    "CPU [ms]",
    "CPU [ORB]",
    "memory [MB]",
]
_SENSOR_HEADER = ["recording", "scale error", "stated sigma", "SE(3) [m]", "ATE [m]", "live [m]", "CPU [ORB]"]
_FLIGHT_HEADER = [
    "flight",
    "frames",
    "path [m]",
    "ATE [cm]",
    "live [cm]",
    "scale error",
    "stated sigma",
    "to the surface [cm]",
    "within 5 cm",
    "CPU [ORB]",
]


def _conditions(release: dict[str, Any]) -> str:
    machine = release["machine"]
    return _block(
        f"Version {release['version']}, {release['date']}, {machine['cores']} cores ({machine['cpu']}), "
        f"one pass of ORB {machine['orb_ms']:.0f} ms. {release.get('note', '')}".rstrip()
    )


def _summary(runs: dict[str, Figures], peers: Sequence[dict[str, Any]]) -> list[list[str]]:
    return [
        [title, _spread(f, "ate_m"), _spread(f, "map_median_m", "{:.1f}", 100.0), _median(f, "cpu_orb", "{:.1f}"),
         _peer(best) if (best := _best(name, peers)) else ""]
        for name, title in RECORDINGS.items()
        for f in (runs[name],)
    ]  # fmt: skip


def _accuracy(f: Figures, title: str) -> list[str]:
    return [
        title,
        f"{f['seeds']}",
        _spread(f, "ate_m"),
        _spread(f, "online_m"),
        _spread(f, "se3_m"),
        _off(f, "scale"),
        _median(f, "scale_sigma", "{:.0f} %", 100.0),
    ]


def _map_and_cost(f: Figures, title: str) -> list[str]:
    return [
        title,
        _median(f, "frames", "{:.0f}"),
        _spread(f, "supported_end", "{:.0f}", 100.0, unit=" %"),
        _median(f, "map_points", "{:.0f}"),
        _spread(f, "map_median_m", "{:.1f}", 100.0),
        _median(f, "cpu_ms", "{:.0f}"),
        _spread(f, "cpu_orb", "{:.1f}"),
        _median(f, "memory_mb", "{:.0f}"),
    ]


def _with_sensor(runs: dict[str, Figures], cells: str) -> list[list[str]]:
    return [
        [title, _off(f, "scale"), _median(f, "scale_sigma", "{:.1f} %", 100.0), _spread(f, "se3_m"),
         _spread(f, "ate_m"), _spread(f, "online_m"), _spread(f, "cpu_orb", "{:.1f}")]
        for name, title in RECORDINGS.items()
        if (f := runs.get(f"{cells}/{name.partition('/')[0]}"))
    ]  # fmt: skip


def _flight(f: Figures, title: str) -> list[str]:
    return [
        title,
        _median(f, "frames", "{:.0f}"),
        _median(f, "path_m", "{:.0f}"),
        _spread(f, "ate_m", "{:.1f}", 100.0),
        _spread(f, "online_m", "{:.1f}", 100.0),
        _off(f, "scale"),
        _median(f, "scale_sigma", "{:.1f} %", 100.0),
        _spread(f, "map_median_m", "{:.1f}", 100.0),
        _median(f, "map_within_5cm", "{:.0f} %", 100.0),
        _spread(f, "cpu_orb", "{:.1f}"),
    ]


def _peers(runs: dict[str, Figures], peers: Sequence[dict[str, Any]]) -> list[str]:
    """A table a recording: this project's runs, then every other system's."""
    parts = []
    for name, title in RECORDINGS.items():
        f = runs[name]
        coverage = _spread(f, "supported_end", "{:.0f}", 100.0, unit=" %")
        costs = [_median(f, key, "{:.0f}") for key in ("cpu_ms", "memory_mb")]
        rows = [["**this project**", _spread(f, "ate_m"), coverage, *costs, f"runs: {f['seeds']}; all frames"]]
        for peer in peers:
            if peer["sequence"].split()[0] == name.partition("/")[0]:
                rows.append([
                    peer["system"], " ".join(f"{v:.4g}" for v in peer["ate_m"]), _coverage(peer),
                    f"{peer.get('cpu_ms_per_frame', '')}", f"{peer.get('peak_rss_mb', '')}",
                    f"{peer['conditions']}; {peer['source']}",
                ])  # fmt: skip
        header = ("system", "ATE [m]", "frames with a pose", "CPU [ms]", "memory [MB]", "conditions; source")
        parts.append(f"### {title}{_table(header, rows).rstrip()}")
    return parts


def _block_caption(f: Figures) -> str:
    return (
        f"ATE {_median(f, 'ate_m', '{:.1f}', 100.0)} cm over {_median(f, 'path_m', '{:.0f}')} m, scale error "
        f"{_off(f, 'scale')}, map {_median(f, 'map_median_m', '{:.1f}', 100.0)} cm from the true surfaces"
    )


def _chance_caption(f: Figures) -> str:
    return f"ATE {_spread(f, 'ate_m')} m over {f['seeds']} perturbed starts"


def _ablation_conditions(ablation: dict[str, Any]) -> str:
    settings = ablation["settings"]
    return (
        f"version {ablation['version']}, {ablation['made'][:10]}, the first {settings['max_frames']} frames of each "
        f"recording, runs: {len(settings['seeds'])}"
    )


def _ablated(rows: dict[str, list[dict[str, Any]]], name: str) -> tuple[list[str], list[list[str]]]:
    """Header and lines of a table: the default's runs, and those of a row with one change."""
    recordings = list(dict.fromkeys(run["sequence"] for run in rows[name]))
    lines = [
        [
            title,
            *(
                _ablated_run([r["figures"] for r in rows[row] if r["sequence"] == recording])
                for recording in recordings
            ),
        ]
        for title, row in (("default", "default"), ("changed", name))
    ]
    return ["ATE [m]; map [cm]", *(RECORDINGS[recording].split(",")[0] for recording in recordings)], lines


def _ablated_run(runs: Sequence[Figures]) -> str:
    """Median errors of a cell's trajectory and map."""
    ate, surface = ([f[key] for f in runs if f.get(key) is not None] for key in ("ate_sim3_m", "map_median_m"))
    if not ate:
        return "no trajectory"
    return f"{median(ate):.4f}" + (f"; {100 * median(surface):.1f}" if surface else "")


def _best(name: str, peers: Sequence[dict[str, Any]]) -> dict[str, Any] | None:
    """The other monocular system with the lowest median error on the same recording that was measured on a CPU."""
    own = [p for p in peers if p["sequence"] == name.partition("/")[0] and p["source"].startswith("measured")]
    own = [p for p in own if "RGB-D" not in p["system"]]
    return min(own, key=lambda p: sorted(p["ate_m"])[len(p["ate_m"]) // 2], default=None)


def _peer(peer: dict[str, Any]) -> str:
    low, high = min(peer["ate_m"]), max(peer["ate_m"])
    ate = f"{low:.3g}" if low == high else f"{low:.3g}–{high:.3g}"
    return f"{peer['system']} {ate}" + (f", {_coverage(peer)}" if _coverage(peer) else "")


def _coverage(peer: dict[str, Any]) -> str:
    known = peer.get("coverage", ())
    ends = dict.fromkeys(f"{100 * v:.0f}" for v in (min(known), max(known))) if known else ()
    return "–".join(ends) + " %" if ends else ""


def _median(f: Figures, key: str, text: str = "{:.4f}", factor: float = 1.0) -> str:
    return text.format(factor * f[key][0]) if key in f else "–"


def _spread(f: Figures, key: str, text: str = "{:.4f}", factor: float = 1.0, to: str = "–", unit: str = "") -> str:
    """Median, and the range behind it when the runs differ."""
    if key not in f:
        return "–"
    middle, low, high = (text.format(factor * v) for v in f[key])
    return f"{middle}{unit}" + ("" if low == high else f" ({low}{to}{high})")


def _off(f: Figures, key: str) -> str:
    """Error of the scale: the factor that lengths must be multiplied by, minus 1, as ``edgeslam eval`` prints it."""
    errors = {key: [round(100 * (v - 1), 1) + 0.0 for v in f[key]]} if key in f else {}  # + 0.0: no minus before zero
    return _spread(errors, key, "{:+.1f}", to="\u00a0to\u00a0", unit="\u00a0%")


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return _block("\n".join("|" + "|".join(line) + "|" for line in lines))


def _block(text: str) -> str:
    """Between blank lines: what follows a comment on its line would not be Markdown."""
    return f"\n\n{text}\n\n"


def rewritten(text: str, made: dict[str, str]) -> str:
    """A document with its blocks as they should be.

    Raises:
        KeyError: If it has a block that no release makes.
    """
    return BLOCK.sub(lambda m: f"<!-- results: {m[1]} -->{made[m[1]]}<!-- end -->", text)


def current() -> dict[str, str]:
    """Blocks of the latest release."""
    return blocks(
        newest(),
        json.loads(ABLATION.read_text(encoding="utf-8")),
        tomllib.loads(PEERS.read_text(encoding="utf-8"))["peer"],
    )


def main() -> None:
    """Rewrite every page that changed."""
    made = current()
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        if (new := rewritten(text, made)) != text:
            page.write_text(new, encoding="utf-8")
            sys.stdout.write(f"{page.relative_to(ROOT)}\n")


if __name__ == "__main__":
    main()
