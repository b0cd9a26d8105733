"""Markdown tables read back."""


def rows(text: str) -> list[list[str]]:
    """Cells of all table lines but the rules under their titles."""
    lines = [line for line in text.splitlines() if line.startswith("|") and not set(line) <= set("|-:")]
    return [[cell.strip() for cell in line[1:-1].split("|")] for line in lines]


def row(text: str, name: str) -> dict[str, str]:
    """Cells of the first line that begins with a name, by the titles of the first table."""
    titles, *lines = rows(text)
    return dict(zip(titles, next(line for line in lines if line[0] == name), strict=True))
