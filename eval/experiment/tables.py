"""Tables of text: aligned for a terminal, or Markdown that reads as well unrendered."""

import textwrap
from collections.abc import Sequence


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
