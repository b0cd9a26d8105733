"""A notebook as a page of Markdown, with the outputs that it was saved with."""

import json
from pathlib import Path
from typing import Any


def notebook_page(path: Path) -> str:
    """Text, code and outputs in order; pictures are inside the page."""
    book = json.loads(path.read_text(encoding="utf-8"))
    parts = [part for cell in book["cells"] for part in _cell(cell)]
    return "\n\n".join([*parts, f"The notebook: `examples/notebooks/{path.name}`"]) + "\n"


def _cell(cell: dict[str, Any]) -> list[str]:
    text = "".join(cell["source"])
    if cell["cell_type"] == "markdown":
        return [text]
    return [f"```python\n{text}\n```", *(part for output in cell["outputs"] if (part := _output(output)))]


def _output(output: dict[str, Any]) -> str:
    if output.get("name") == "stderr":
        return ""
    data = output.get("data", {})
    if "image/png" in data:
        return f'<img alt="what the cell draws" src="data:image/png;base64,{"".join(data["image/png"].split())}">'
    text = "".join(output.get("text", data.get("text/plain", "")))
    return f"```text\n{text.rstrip()}\n```" if text.strip() else ""
