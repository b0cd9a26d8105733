"""``comparison.html``: two runs side by side, one self-contained page without scripts or paths."""

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.associate import match
from edgeslam_torch.eval.inputs.run_folder import RunFolder, open_run
from edgeslam_torch.eval.metrics.run_score import RunScore
from edgeslam_torch.eval.report import line_drawings, words
from edgeslam_torch.eval.report.page import judge_run, upright
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.geometry import sim3
from edgeslam_torch.types import FloatArray

COLOURS = ("var(--tracked)", "var(--predicted)")
_LETTERS = "AB"
_HEAD = ("", "A", "B", "B \u2212 A")
_STYLE = Path(__file__).parent / "template" / "style.css"
_MIN_COMMON = 10
"""Minimum number of common frames to align two paths."""
_MORE_STYLE = """
.two { display: grid; grid-template-columns: 1fr 1fr; gap: 24px; }
.two img, .two svg { display: block; width: 100%; height: auto; border-radius: 6px; background: var(--panel); }
.mark { display: inline-block; width: 12px; height: 12px; margin-right: 8px; border-radius: 2px; }
td + td, th + th { text-align: right; }
.words td, .words th { text-align: left; white-space: normal; }
svg text { fill: var(--soft); font-size: 13px; }
.curve { display: block; width: 100%; min-width: 640px; }
@media (max-width: 700px) {
  .two { grid-template-columns: 1fr; }
  th, td { padding-right: 10px; }
  td:first-child { white-space: normal; }
  td:last-child { min-width: 0; }
}
"""


@dataclass(frozen=True, slots=True)
class _Side:
    """One of the two runs."""

    run: RunFolder
    score: RunScore | None
    positions: FloatArray
    """``(F, 3)`` in its own world, z up."""
    title: str


@dataclass(frozen=True, slots=True)
class _Laid:
    """One path aligned to the other, which is metric if either is."""

    still: int
    """Index of the run that stays where it is; its unit is that of all lengths."""
    paths: tuple[FloatArray, FloatArray]
    """``(F, 3)`` of both."""
    scale: float
    """Length of the one that stays over that of the other."""
    times_s: FloatArray
    """``(M,)`` of common frames, from the beginning of the one that stays."""
    apart: FloatArray
    """``(M,)``"""


def write_comparison(
    first: Path, second: Path, out: Path, groundtruth: Path | str | None = None, judge_map: bool = True
) -> Path:
    """Write the page about two runs.

    Args:
        first: Output folder of ``edgeslam run``, or a trajectory file.
        second: The other.
        out: File to write.
        groundtruth: As for a report.
        judge_map: Compare the maps with measured depth too.

    Raises:
        EdgeSlamError: If one of them holds no run, they are the same, or the given ground truth fits one of them not.
    """
    if first.exists() and second.exists() and first.samefile(second):
        raise EvaluationError(f"{first}: given twice; a comparison needs two runs")
    sides = [
        _side(folder, letter, groundtruth, judge_map) for folder, letter in zip((first, second), _LETTERS, strict=True)
    ]
    write_text(out, _page(sides))
    return out


def _side(folder: Path, letter: str, groundtruth: Path | str | None, judge_map: bool) -> _Side:
    run = open_run(folder)
    score, truth = judge_run(run, groundtruth, judge_map)
    positions = run.trajectory.positions @ upright(run.trajectory, score, truth).T
    return _Side(run, score, positions, f"{letter}: {words.readable(run.name)}")


def _page(sides: Sequence[_Side]) -> str:
    laid = _laid(sides)
    title = html.escape(" and ".join(side.title for side in sides))
    rows = _figures(*sides)
    body = [
        f'<header class="wrap"><p class="eyebrow">EdgeSLAM-Torch, two runs</p><h1>{title}</h1></header>',
        f'<section class="wrap two">{"".join(map(_about, range(2), sides))}</section>',
        f'<section class="wrap"><h2>Figures</h2>{_table(_HEAD, rows)}</section>',
        f'<section class="wrap"><h2>Paths</h2>{_paths(sides, laid)}</section>',
        _different("Settings that differ", *(_settings(side.run) for side in sides)),
        _different("Other values that differ", *(_values(side.run) for side in sides)),
    ]
    style = _STYLE.read_text(encoding="utf-8") + _MORE_STYLE
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<meta name="color-scheme" content="light dark"><title>{title}</title><link rel="icon" href="data:,">'
        f"<style>{style}</style></head><body>{''.join(body)}"
        '<footer class="wrap"><p>Made by EdgeSLAM-Torch. Each run has its own report.</p></footer></body></html>\n'
    )


def _about(index: int, side: _Side) -> str:
    """Story, warnings and picture of one run."""
    said = "".join(f"<li>{html.escape(text)}</li>" for text in words.warnings(side.run.summary))
    picture = side.run.path / "map.png"
    shown = ""
    if picture.is_file():
        data = base64.b64encode(picture.read_bytes()).decode("ascii")
        shown = f'<img alt="Map of {html.escape(side.title)}" src="data:image/png;base64,{data}">'
    mark = f'<i class="mark" style="background:{COLOURS[index]}"></i>'
    return (
        f"<div><h2>{mark}{html.escape(side.title)}</h2><p>{html.escape(words.story(side.run, side.score))}</p>"
        f'<ul class="warnings">{said}</ul>{shown}</div>'
    )


def _figures(a: _Side, b: _Side) -> list[list[str]]:
    """Name, both values, and their difference where both are numbers."""
    values = [_numbers(side) for side in (a, b)]
    rows = []
    for name in values[0]:
        pair = [side[name] for side in values]
        if pair == [None, None]:
            continue
        texts = ["\u2013" if value is None else f"{value[0]:.{value[1]}f}{value[2]}" for value in pair]
        change = ""
        if pair[0] is not None and pair[1] is not None and pair[0][2] == pair[1][2]:
            digits, unit = pair[0][1:]
            change = f"{pair[1][0] - pair[0][0]:+.{digits}f}{unit}"
        rows.append([name, *texts, change])
    return rows


def _numbers(side: _Side) -> dict[str, tuple[float, int, str] | None]:
    """Figures by name: value, digits after the point, unit; None where the run does not have one."""
    summary, score = side.run.summary, side.score
    found: dict[str, tuple[float, int, str] | None] = {}

    def add(name: str, value: object, digits: int = 0, unit: str = "", factor: float = 1.0) -> None:
        known = isinstance(value, int | float) and not isinstance(value, bool) and np.isfinite(value)
        found[name] = (factor * float(value), digits, unit) if known else None  # type: ignore[arg-type]

    in_metres = score is not None and score.units == "metres"
    add("position error (ATE, Sim(3))", score and score.ate_sim3_m, 2, " cm", 100.0)
    add("position error without scaling (SE(3))", score.ate_se3_m if score and in_metres else None, 2, " cm", 100.0)
    add("rotation error", score and score.rotation_deg, 2, "\u00b0")
    add("map error (median)", score.map.median_m if score and score.map else None, 2, " cm", 100.0)
    add("frames", summary.get("offered", len(side.run.trajectory)))
    add("frames tracked", side.run.trusted_frames)
    add("times lost", summary.get("lost_events"))
    scale = summary.get("scale")
    parts = scale if isinstance(scale, dict) and scale.get("units") == "metres" else {}
    value, sigma = parts.get("value"), parts.get("sigma")
    both = isinstance(value, int | float) and isinstance(sigma, int | float) and value
    add("scale, 1 sigma", sigma / value if both else None, 1, " %", 100.0)  # type: ignore[operator]
    steps = np.linalg.norm(np.diff(side.positions, axis=0), axis=1)
    add("length of the path", float(steps.sum()), 2, f" {words.unit(side.run)}")
    counts = summary.get("map")
    for key in ("keyframes", "anchors", "edge_points"):
        add(key.replace("_", " "), counts.get(key) if isinstance(counts, dict) else None)
    add("frames per second", summary.get("fps"), 1)
    add("CPU per frame", summary.get("cpu_ms_per_frame"), 1, " ms")
    add("memory", summary.get("peak_rss_mb"), 0, " MB")
    return found


def _laid(sides: Sequence[_Side]) -> _Laid | None:
    """One run on the other by their common frames; None without enough of them, or if one stood still."""
    still = 1 if words.unit(sides[0].run) != "m" and words.unit(sides[1].run) == "m" else 0
    there, moving = sides[still], sides[1 - still]
    stamps_there, stamps_moving = there.run.trajectory.stamps_s, moving.run.trajectory.stamps_s
    i, j = match(stamps_there, stamps_moving)
    if len(i) < _MIN_COMMON:
        return None
    S = sim3.fit(moving.positions[j], there.positions[i])
    if S is None:
        return None
    moved = sim3.transform(S, moving.positions)
    apart = np.linalg.norm(moved[j] - there.positions[i], axis=1)
    paths = (moved, there.positions) if still else (there.positions, moved)
    return _Laid(still, paths, sim3.scale_of(S), stamps_there[i] - stamps_there[0], apart)


def _paths(sides: Sequence[_Side], laid: _Laid | None) -> str:
    """Both paths from above and from the side, and how far they are apart over time."""
    if laid is None:
        note = "The runs have no frames in common (or stood still), so each path is drawn in its own world."
        drawn = "".join(_views([side.positions], [COLOURS[k]], words.unit(side.run)) for k, side in enumerate(sides))
        return f'<p class="note">{note}</p>{drawn}'
    unit = words.unit(sides[laid.still].run)
    there, moved = _LETTERS[laid.still], _LETTERS[1 - laid.still]
    rms, most = float(np.sqrt(np.mean(laid.apart**2))), float(laid.apart.max())
    note = (
        f"{moved} is aligned to {there} by {len(laid.apart)} common frames (rotated, translated, scaled by "
        f"{laid.scale:.4g}); the remaining distance is {rms:.3g} {unit} RMS, {most:.3g} {unit} at most."
    )
    chart = line_drawings.chart(laid.times_s, laid.apart, "var(--accent)", f"apart [{unit}]")
    return (
        f'<p class="note">{note}</p>{_views(laid.paths, COLOURS, unit)}'
        f'<figure><figcaption>Distance over time</figcaption><div class="scroll">{chart}</div></figure>'
    )


def _views(paths: Sequence[FloatArray], colours: Sequence[str], unit: str) -> str:
    top = line_drawings.view([p[:, :2] for p in paths], colours, unit)
    side = line_drawings.view([p[:, [0, 2]] for p in paths], colours, unit)
    return (
        f'<div class="two"><figure><figcaption>Top view</figcaption>{top}</figure>'
        f"<figure><figcaption>Side view</figcaption>{side}</figure></div>"
    )


def _settings(run: RunFolder) -> dict[str, str]:
    """``section.key`` to value of ``config.toml``, as text."""
    path = run.path / "config.toml"
    if not path.is_file():
        return {}
    out, section = {}, ""
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        name, equals, value = line.partition("=")
        if line.startswith("["):
            section = line.strip("[] ") + "."
        elif equals and not line.startswith("#"):
            out[section + name.strip()] = words.without_folders(value.strip())
    return out


def _values(run: RunFolder) -> dict[str, str]:
    """``summary.json`` without what the figures contain."""
    shown = ("source: ", "fps", "cpu", "peak", "stage", "step", "warnings", "pieces", "map: ", "losses: ")
    rows = words.flat_rows(run.summary)
    return {name: value for name, value in rows if not name.startswith(shown)}


def _different(heading: str, a: dict[str, str], b: dict[str, str]) -> str:
    names = list(dict.fromkeys([*a, *b]))
    rows = [[name, a.get(name, "\u2013"), b.get(name, "\u2013")] for name in names if a.get(name) != b.get(name)]
    if not rows:
        return f'<section class="wrap"><h2>{heading}</h2><p class="note">None.</p></section>'
    return f'<section class="wrap"><h2>{heading}</h2><div class="words">{_table(["", "A", "B"], rows)}</div></section>'


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    first = "".join(f"<th>{html.escape(cell)}</th>" for cell in head)
    rest = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div class="scroll"><table><tr>{first}</tr>{rest}</table></div>'
