"""``index.html``: a row and a picture per flight; sorted and filtered in the browser, without network."""

import html
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from edgeslam_torch.eval.experiment.figures import Figure
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.fleet.folder import PAGE, RECORD, TABLE
from edgeslam_torch.fleet.table import COLUMNS, DONE, FAILED, WAITING, Row, cell, counts, medians

_TEMPLATE = Path(__file__).parent / "template"


def write_page(folder: Path, rows: Sequence[Row]) -> None:
    """Write the page; its links are relative to ``folder``, so that the folder may be moved and shared."""
    write_text(folder / PAGE, render(rows))


def render(rows: Sequence[Row]) -> str:
    """The page as text."""
    shown = [column for column in COLUMNS if any(cell(column, row.figures.get(column.name)) for row in rows)]
    words = {c.name for c in shown if any(isinstance(row.figures.get(c.name), str) for row in rows)}
    titles = [("flight", False), ("state", False), *((c.title, c.name not in words) for c in shown), ("remarks", False)]
    parts = {
        "style": _part("style.css"),
        "script": _part("sort.js"),
        "summary": html.escape(_summary(rows)),
        "tables": f'<a href="{TABLE}">{TABLE}</a>, <a href="{RECORD}">{RECORD}</a>',
        "head": "".join(_head(title, numeric) for title, numeric in titles),
        "rows": "\n".join(_row(row, shown) for row in rows),
    }
    page = _part("page.html")
    before, *rest = page.split("{{")
    return before + "".join(parts[name] + text for name, _, text in (piece.partition("}}") for piece in rest))


def _part(name: str) -> str:
    return (_TEMPLATE / name).read_text(encoding="utf-8")


def _summary(rows: Sequence[Row]) -> str:
    count = counts(rows)
    words = [f"{count[DONE]} of {len(rows)} flights finished"]
    words += [f"{count[FAILED]} failed"] if count[FAILED] else []
    words += [f"{count[WAITING]} not run yet"] if count[WAITING] else []
    middle = medians(rows)
    named = [(c, middle[c.name]) for c in COLUMNS if c.name in ("tracked", "ate_m", "cpu_ms") and c.name in middle]
    if named:
        words.append("medians: " + ", ".join(f"{column.title} = {cell(column, value)}" for column, value in named))
    return "; ".join(words) + "."


def _head(title: str, numeric: bool) -> str:
    kind = ' class="number"' if numeric else ""
    return f'<th{kind} scope="col"><button type="button">{html.escape(title)}</button></th>'


def _row(row: Row, shown: Sequence[Figure]) -> str:
    name = html.escape(row.name)
    target = f"{row.folder}/report.html" if row.folder else row.log
    link = f'<a href="{_link(target)}">{name}</a>' if target else name
    image = f'<img loading="lazy" src="{_link(row.picture)}" alt="Map of {name}" width="180">' if row.picture else ""
    reason = f'<p class="reason">{html.escape(row.reason)}</p>' if row.reason else ""
    state = f'<td class="{row.state}" data-key="{row.state}">{row.state}{reason}</td>'
    cells = [f'<td data-key="{name}">{link}{image}</td>', state]
    for column in shown:
        value = row.figures.get(column.name)
        text = html.escape(cell(column, value))
        key = f' data-key="{float(value)!r}"' if isinstance(value, int | float) and text else ""
        cells.append(f'<td class="number"{key}>{text}</td>' if not isinstance(value, str) else f"<td>{text}</td>")
    again = [f"attempt {row.attempts}"] if row.attempts > 1 else []
    remarks = html.escape("; ".join([*again, *row.notes]))
    return f'<tr data-state="{row.state}">{"".join(cells)}<td class="remarks"><p>{remarks}</p></td></tr>'


def _link(path: str) -> str:
    return html.escape(quote(path))
