"""Figures of runs, and two sets of runs side by side: which difference of their medians is more than noise.

Two medians differ by chance by ``2 sqrt(s_a^2/n_a + s_b^2/n_b)``, with ``s`` the sample standard deviation over the
seeds, and never by less than a figure's floor, for what one record cannot see of itself.
"""

import textwrap
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.files.record_files import read_mapping

_SIGMAS = 2.0
_MOST_NAMED = 8
"""Names of only one of two records that are listed."""
_CONDITIONS = ("machine", "seeds", "mode", "max_frames", "overrides")

Run = dict[str, Any]
"""A run, with its ``figures`` by name; None where it has none."""


@dataclass(frozen=True, slots=True)
class Figure:
    """One figure of a run."""

    name: str
    """Among the run's figures."""
    title: str
    text: str = "{:.4f}"
    factor: float = 1.0
    """On the value, before it is printed."""
    spread: bool = False
    """Of several runs, print the lowest and the highest too."""
    floor: float | None = None
    """Difference below which two medians count as equal; None is not compared."""
    one_seed: float | None = None
    """The same for a single run, whose scatter is not known; `floor` when None."""
    relative: bool = True
    """Whether the floors are shares of the first median."""
    lower_is_better: bool = True

    def cell(self, values: Sequence[float | None], none: str = "-") -> str:
        """Median of several runs' values."""
        known = self.factor * np.array([v for v in values if v is not None and np.isfinite(v)])
        if len(known) == 0:
            return none
        text = self.text.format(float(np.median(known)))
        if self.spread and len(known) > 1:
            text += f" [{self.text.format(known.min())} {self.text.format(known.max())}]"
        return text

    def values(self, runs: Sequence[Run]) -> list[float]:
        """Of the runs that have it."""
        found = [run["figures"].get(self.name) for run in runs]
        return [float(v) for v in found if v is not None and np.isfinite(v)]

    def noise(self, before: Sequence[float], after: Sequence[float]) -> float:
        """Difference of the medians of two sets of values that means nothing."""
        variances = [np.var(values, ddof=1) / len(values) for values in (before, after) if len(values) > 1]
        by_chance = _SIGMAS * float(np.sqrt(sum(variances)))
        floor = self.one_seed if self.one_seed is not None and min(len(before), len(after)) == 1 else self.floor
        return max(by_chance, (floor or 0.0) * (abs(float(np.median(before))) if self.relative else 1.0))

    def verdict(self, before: Sequence[float], after: Sequence[float]) -> str:
        """``better``, ``worse`` or ``same``."""
        change = float(np.median(after) - np.median(before))
        if abs(change) <= self.noise(before, after):
            return "same"
        return "better" if (change < 0) == self.lower_is_better else "worse"

    def change(self, before: Sequence[Run], after: Sequence[Run]) -> str:
        """The verdict on runs; empty where the first have no such figure or it is not compared."""
        a, b = self.values(before), self.values(after)
        if not a or self.floor is None:
            return ""
        return self.verdict(a, b) if b else "worse"  # what there is no more is worse


def plain(figures: Mapping[str, Any]) -> dict[str, float | None]:
    """For JSON: numbers, and None for what is missing or not finite."""
    return {name: float(v) if v is not None and np.isfinite(v) else None for name, v in figures.items()}


def grouped(runs: Sequence[Run], key: str) -> dict[str, list[Run]]:
    """Runs by one of their fields, in the order in which they appear."""
    return {name: [run for run in runs if run[key] == name] for name in dict.fromkeys(run[key] for run in runs)}


def compared(
    before: Mapping[str, Any], after: Mapping[str, Any], rows: str, key: str, figures: Sequence[Figure]
) -> str:
    """Two records side by side: medians and their ratio, a line for every source, and what to beware of.

    Args:
        before: A record.
        after: Another one.
        rows: Key of a record's runs.
        key: Of a run's source.
        figures: Compared where they have a floor.
    """
    head = f"{before.get('commit')} -> {after.get('commit')}, medians, ratio; ! worse, + better by more than the noise"
    old, new = grouped(before[rows], key), grouped(after[rows], key)
    names, figures = [name for name in new if name in old], [figure for figure in figures if figure.floor is not None]
    worse, lines = [], []
    for name in names:
        line = [name]
        for figure in figures:
            a, b = figure.values(old[name]), figure.values(new[name])
            first, second = (float(np.median(values)) if values else 0.0 for values in (a, b))
            ratio = f" x{second / first:.2f}" if figure.relative and b and first > 0 else ""
            verdict = figure.change(old[name], new[name])
            mark = {"worse": " !", "better": " +"}.get(verdict, "")
            line.append(f"{figure.cell(a)} -> {figure.cell(b)}{ratio}{mark}" if a or b else "-")
            if verdict == "worse":
                worse.append(f"{name} {figure.title}{ratio if b else ' (none any more)'}")
        lines.append(line)
    text = [head, *_other_conditions(before, after), ""]
    text += [markdown_table(["runs of", *(figure.title for figure in figures)], lines), ""]
    missing = sorted(old.keys() ^ new.keys())
    named = ", ".join(missing) if len(missing) <= _MOST_NAMED else f"{len(missing)} names"
    text += [f"only in one of the two: {named}"] if missing else []
    text += [f"worse: {', '.join(worse) if worse else 'nothing'}"]
    if any(len(runs[name]) == 1 for name in names for runs in (old, new)):
        text += ["with one seed the scatter is not known: only the floors of the figures are applied"]
    return "\n".join(text) + "\n"


def read_record(path: Path, command: str, formats: Container[int], rows: str) -> dict[str, Any]:
    """A record that an ``edgeslam`` command wrote, with a list of runs under the key ``rows``.

    Raises:
        EvaluationError: If the file is missing or no such record.
    """
    record = read_mapping(path, "JSON", EvaluationError)
    runs = record.get(rows)
    is_list = isinstance(runs, list) and all(isinstance(run, dict) for run in runs)
    if record.get("format") not in formats or not is_list:
        raise EvaluationError(f"{path}: not a result of 'edgeslam {command}' of this version")
    return record


def _other_conditions(before: Mapping[str, Any], after: Mapping[str, Any]) -> list[str]:
    """What two records differ in beside their runs, one line each."""
    lines = []
    for key in (key for key in _CONDITIONS if key in before and key in after):
        a, b = before[key], after[key]
        if isinstance(a, dict) and isinstance(b, dict):
            lines += [f"beware: {k} was {a[k]}, then {b.get(k)}" for k in a if a[k] != b.get(k)]
        elif a != b:
            lines.append(f"beware: {key} was {a}, then {b}")
    return lines


def text_table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Aligned columns, the first to the left, titles above them in as many lines as their words need.

    Example:
        >>> print(text_table(["run", "ATE [m]"], [["a", "0.0100"], ["other", "0.2"]]))
                  ATE
        run       [m]
        a      0.0100
        other     0.2
    """
    cells = list(zip(*rows, strict=True))
    widths = [
        max(max(map(len, words), default=0), *(len(word) for word in ([title] if i == 0 else title.split())))
        for i, (title, words) in enumerate(zip(titles, cells, strict=True))
    ]
    heads = [[title] if i == 0 else textwrap.wrap(title, widths[i]) for i, title in enumerate(titles)]
    height = max(map(len, heads))
    above = zip(*([""] * (height - len(head)) + head for head in heads), strict=True)
    lines = [
        "  ".join(
            [line[0].ljust(widths[0]), *(word.rjust(width) for word, width in zip(line[1:], widths[1:], strict=True))]
        )
        for line in (*above, *rows)
    ]
    return "\n".join(line.rstrip() for line in lines)


def markdown_table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """The same as Markdown, numbers to the right, the first and the last column to the left.

    Example:
        >>> print(markdown_table(["run", "ATE [m]", "limits"], [["a", "0.0100", "pass"]]))
        | run | ATE [m] | limits |
        |-----|--------:|--------|
        | a   |  0.0100 | pass   |
    """
    ends = (0, len(titles) - 1)
    widths = [max(3, *(len(line[k]) for line in (titles, *rows))) for k in range(len(titles))]

    def text(line: Sequence[str]) -> str:
        cells = (c.ljust(w) if k in ends else c.rjust(w) for k, (c, w) in enumerate(zip(line, widths, strict=True)))
        return "| " + " | ".join(cells) + " |"

    rule = "|" + "|".join("-" * (w + 1) + ("-" if k in ends else ":") for k, w in enumerate(widths)) + "|"
    return "\n".join([text(titles), rule, *map(text, rows)])
