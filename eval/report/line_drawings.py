"""Paths and curves as SVG, and tables, for pages without scripts."""

import html
import math
from collections.abc import Sequence

import numpy as np

from edgeslam_torch.types import FloatArray

_WIDTH, _HEIGHT, _MARGIN = 520, 390, 24
_CHART_WIDTH, _CHART_HEIGHT = 1080, 190
_LEFT = 72
_MOST = 1500
"""Points of a line."""


def view(paths: Sequence[FloatArray], colours: Sequence[str], unit: str) -> str:
    """Paths ``(N, 2)`` at one scale, the second coordinate upwards, with a bar of a round length."""
    together = np.concatenate([path for path in paths if len(path)] or [np.zeros((1, 2))])
    low, high = together.min(axis=0), together.max(axis=0)
    extent = np.maximum(high - low, 1e-9)
    scale = float(min((_WIDTH - 2 * _MARGIN) / extent[0], (_HEIGHT - 3 * _MARGIN) / extent[1]))
    middle = (low + high) / 2
    centre = np.array([_WIDTH / 2, (_HEIGHT - _MARGIN) / 2])
    lines = []
    for path, colour in zip(paths, colours, strict=True):
        xy = centre + (path - middle) * [scale, -scale]
        lines.append(_line(xy, colour))
        if len(xy):
            lines.append(f'<circle cx="{xy[0, 0]:.1f}" cy="{xy[0, 1]:.1f}" r="4" fill="{colour}"/>')
    bar = _round_number(0.3 * _WIDTH / scale)
    y = _HEIGHT - 12
    lines.append(f'<path d="M{_MARGIN} {y}h{bar * scale:.1f}" stroke="var(--soft)" stroke-width="2"/>')
    lines.append(f'<text x="{_MARGIN}" y="{y - 6}">{bar:g} {unit}</text>')
    return f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img">{"".join(lines)}</svg>'


def chart(x: FloatArray, y: FloatArray, colour: str, label: str) -> str:
    """A curve over seconds, from zero upwards."""
    top = max(float(y.max(initial=0.0)), 1e-9)
    span = max(float(x[-1] - x[0]), 1e-9)
    right, bottom = _CHART_WIDTH - 8, _CHART_HEIGHT - 24
    xy = np.stack([_LEFT + (x - x[0]) / span * (right - _LEFT), bottom - y / top * (bottom - 20)], axis=1)
    axis = f'<path d="M{_LEFT} 12V{bottom}H{right}" fill="none" stroke="var(--line)"/>'
    texts = (
        f'<text x="{_LEFT - 6}" y="24" text-anchor="end">{top:.3g}</text>'
        f'<text x="{_LEFT - 6}" y="{bottom}" text-anchor="end">0</text>'
        f'<text x="{right}" y="{_CHART_HEIGHT - 6}" text-anchor="end">{x[-1]:.1f} s</text>'
        f'<text x="{_LEFT + 6}" y="16">{label}</text>'
    )
    size = f'viewBox="0 0 {_CHART_WIDTH} {_CHART_HEIGHT}"'
    return f'<svg class="curve" {size} role="img">{axis}{_line(xy, colour)}{texts}</svg>'


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of texts below its titles."""
    first = "".join(f"<th>{html.escape(cell)}</th>" for cell in head)
    rest = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div class="scroll"><table><tr>{first}</tr>{rest}</table></div>'


def _line(xy: FloatArray, colour: str) -> str:
    shown = xy[:: max(1, -(-len(xy) // _MOST))]
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in shown)
    return f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="2" stroke-linejoin="round"/>'


def _round_number(most: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten up to ``most``."""
    power = 10.0 ** math.floor(math.log10(most))
    return max(step * power for step in (1.0, 2.0, 5.0) if step * power <= most * (1 + 1e-9))
