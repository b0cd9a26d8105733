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
from edgeslam_torch.eval.metrics.align import Alignment, umeyama
from edgeslam_torch.eval.metrics.run_score import RunScore
from edgeslam_torch.eval.report import line_drawings, words
from edgeslam_torch.eval.report.page import TEMPLATE, judge_run, upright
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.types import FloatArray

COLOURS = ("var(--tracked)", "var(--predicted)")
_LETTERS = "AB"
_HEAD = ("", "A", "B", "B \u2212 A")
_NONE = "\u2013"
_MIN_COMMON = 10
"""Minimum number of common frames to align two paths."""


@dataclass(frozen=True, slots=True)
class _Side:
    """One of the two runs."""

    run: RunFolder
    score: RunScore | None
    positions: FloatArray
    """``(F, 3)`` in its own world, z up."""
    title: str


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
    sides = []
    for folder, letter in zip((first, second), _LETTERS, strict=True):
        run = open_run(folder)
        score = judge_run(run, groundtruth, judge_map)
        positions = run.trajectory.positions @ upright(run.trajectory, score).T
        sides.append(_Side(run, score, positions, f"{letter}: {words.readable(run.name)}"))
    write_text(out, _page(sides))
    return out


def _page(sides: Sequence[_Side]) -> str:
    title = html.escape(" and ".join(side.title for side in sides))
    body = [
        f'<header class="wrap"><p class="eyebrow">EdgeSLAM-Torch, two runs</p><h1>{title}</h1></header>',
        f'<section class="wrap two">{"".join(map(_about, range(2), sides))}</section>',
        f'<section class="wrap"><h2>Figures</h2>{line_drawings.table(_HEAD, _figures(sides))}</section>',
        f'<section class="wrap"><h2>Paths</h2>{_paths(sides)}</section>',
        _different("Settings that differ", *(_settings(side.run) for side in sides)),
        _different("Other values that differ", *(_values(side.run) for side in sides)),
    ]
    style = "".join((TEMPLATE / name).read_text(encoding="utf-8") for name in ("style.css", "comparison.css"))
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
    picture, shown = side.run.path / "map.png", ""
    if picture.is_file():
        data = base64.b64encode(picture.read_bytes()).decode("ascii")
        shown = f'<img alt="Map of {html.escape(side.title)}" src="data:image/png;base64,{data}">'
    mark = f'<i class="mark" style="background:{COLOURS[index]}"></i>'
    return (
        f"<div><h2>{mark}{html.escape(side.title)}</h2><p>{html.escape(words.story(side.run, side.score))}</p>"
        f'<ul class="warnings">{said}</ul>{shown}</div>'
    )


def _figures(sides: Sequence[_Side]) -> list[list[str]]:
    """Name, both values, and their difference where both are numbers of one unit."""
    rows = []
    for a, b in zip(*(words.figures(side.run, side.score) for side in sides), strict=True):
        texts = [
            f"{value:.{digits}f} {unit}".rstrip() if np.isfinite(value) else _NONE for _, value, digits, unit in (a, b)
        ]
        change = b[1] - a[1]
        difference = f"{change:+.{a[2]}f} {a[3]}".rstrip() if np.isfinite(change) and a[3] == b[3] else ""
        if texts != [_NONE, _NONE]:
            rows.append([a[0], *texts, difference])
    return rows


def _paths(sides: Sequence[_Side]) -> str:
    """Both paths from above and from the side, and how far they are apart over time.

    One is aligned to the other, which is metric if either is, by their common frames; each is drawn alone without
    enough of them, or if one stood still.
    """
    still = 1 if words.unit(sides[0].run) != "m" and words.unit(sides[1].run) == "m" else 0
    there, moving = sides[still], sides[1 - still]
    stamps, unit = there.run.trajectory.stamps_s, words.unit(there.run)
    i, j = match(stamps, moving.run.trajectory.stamps_s)
    try:
        found = umeyama(moving.positions[j], there.positions[i])
    except EvaluationError:
        found = Alignment(degenerate=True)
    if len(i) < _MIN_COMMON or found.degenerate or not found.scale > 0:
        note = "The runs have no frames in common (or stood still), so each path is drawn in its own world."
        drawn = "".join(_views([side.positions], [COLOURS[k]], words.unit(side.run)) for k, side in enumerate(sides))
        return f'<p class="note">{note}</p>{drawn}'
    moved = found.points(moving.positions)
    apart = np.linalg.norm(moved[j] - there.positions[i], axis=1)
    note = (
        f"{_LETTERS[1 - still]} is aligned to {_LETTERS[still]} by {len(i)} common frames (rotated, translated, scaled "
        f"by {found.scale:.4g}); the remaining distance is {float(np.sqrt(np.mean(apart**2))):.3g} {unit} RMS, "
        f"{float(apart.max()):.3g} {unit} at most."
    )
    chart = line_drawings.chart(stamps[i] - stamps[0], apart, "var(--accent)", f"apart [{unit}]")
    paths = [moved, there.positions] if still else [there.positions, moved]
    return (
        f'<p class="note">{note}</p>{_views(paths, COLOURS, unit)}'
        f'<figure><figcaption>Distance over time</figcaption><div class="scroll">{chart}</div></figure>'
    )


def _views(paths: Sequence[FloatArray], colours: Sequence[str], unit: str) -> str:
    drawn = [
        f"<figure><figcaption>{name}</figcaption>{line_drawings.view([p[:, k] for p in paths], colours, unit)}</figure>"
        for name, k in (("Top view", [0, 1]), ("Side view", [0, 2]))
    ]
    return f'<div class="two">{"".join(drawn)}</div>'


def _settings(run: RunFolder) -> dict[str, str]:
    """``section.key`` to value of ``config.toml``, as text."""
    path, out, section = run.path / "config.toml", dict[str, str](), ""
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines() if path.is_file() else ():
        name, equals, value = line.partition("=")
        if line.startswith("["):
            section = line.strip("[] ") + "."
        elif equals and not line.startswith("#"):
            out[section + name.strip()] = words.without_folders(value.strip())
    return out


def _values(run: RunFolder) -> dict[str, str]:
    """``summary.json`` without what the figures contain."""
    shown = ("source: ", "fps", "cpu", "peak", "stage", "step", "warnings", "pieces", "map: ", "losses: ")
    return {name: value for name, value in words.flat_rows(run.summary) if not name.startswith(shown)}


def _different(heading: str, a: dict[str, str], b: dict[str, str]) -> str:
    names = list(dict.fromkeys([*a, *b]))
    rows = [[name, a.get(name, _NONE), b.get(name, _NONE)] for name in names if a.get(name) != b.get(name)]
    if not rows:
        return f'<section class="wrap"><h2>{heading}</h2><p class="note">None.</p></section>'
    table = line_drawings.table(["", "A", "B"], rows)
    return f'<section class="wrap"><h2>{heading}</h2><div class="words">{table}</div></section>'
