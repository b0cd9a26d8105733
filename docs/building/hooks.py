"""What MkDocs does not do by itself: pages from files outside ``docs/``, notebooks, and the generated reference.

README, CHANGELOG, CONTRIBUTING and SECURITY stay where people look for them; here they become pages, and links between
them and ``docs/`` are turned to where the page is. Files that a page links to and that are no pages (an example, the
licence) are copied beside the site as text.
"""

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(Path(__file__).resolve().parent))

from formulas import fenced_as_mathml  # noqa: E402  # beside this file, which MkDocs loads by its path
from notebook_page import notebook_page  # noqa: E402
from reference import NAMES, PACKAGES, api_pages, commands_page, settings_page  # noqa: E402

FROM_THE_ROOT = {"README.md": "index.md"} | {
    f"{name}.md": f"{name}.md" for name in ("CHANGELOG", "CONTRIBUTING", "SECURITY")
}
"""Files at the root, and the pages that they become."""
NOTEBOOKS = ROOT / "examples" / "notebooks"
BOOSTS = {"index.md": 10.0, "start/": 10.0, "guides/": 10.0, "reference/api/": 1e-3, "reference/": 0.1} | {
    "theory/": 0.1,
    "decisions/": 1e-4,
    "CHANGELOG.md": 1e-4,
}
"""Weights of pages in the search by their beginning; all others have 1. A word in a title weighs a thousand times as
much as in the text: guides precede names of the API only by such factors."""
WIDE = ("index.md", "results/", "theory/README.md")
"""Beginnings of pages whose tables and outputs take the room of the list of contents."""
_LINK = re.compile(r"(?<=\]\()([^)#\s:]+)(#[^)\s]*)?(?=\))")
_FENCED = re.compile(r"(^```.*?^```)", re.MULTILINE | re.DOTALL)


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Fill the menu: notebooks, the API, and a folder's pages below its index."""
    for entry in config.nav or []:
        fill(entry)
    return config


def on_post_build(config: MkDocsConfig) -> None:
    """Nothing may come from the network.

    Raises:
        PluginError: If a page would load something from elsewhere.
    """
    if needs := network_needs(Path(config.site_dir)):
        raise PluginError("\n".join(needs))


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are no files of ``docs/``."""
    for name, page in FROM_THE_ROOT.items():
        add(files, config, page, (ROOT / name).read_text(encoding="utf-8"))
    for path in notebooks():
        add(files, config, f"notebooks/{path.stem}.md", notebook_page(path))
    generated = {"reference/settings.md": settings_page(), "reference/commands.md": commands_page(), **api_pages()}
    for uri, content in generated.items():
        add(files, config, uri, content)
    for name in sorted({name for file in files.documentation_pages() for name in copied_by(file)}):
        add(files, config, f"files/{name}.txt", (ROOT / name).read_text(encoding="utf-8"))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links to where their pages are, set formulas, weigh the page for the search."""
    page.meta["search"] = {"boost": boost(page.file.src_uri)}
    if page.file.src_uri.startswith(WIDE):
        page.meta["hide"] = ["toc"]
    markdown = fenced_as_mathml(markdown)
    here = home(page.file.src_uri)
    parts = _FENCED.split(markdown)
    parts[::2] = [
        _LINK.sub(lambda m: turned(m[1], page.file.src_uri, here) + (m[2] or ""), text) for text in parts[::2]
    ]
    return "".join(parts)


def boost(uri: str) -> float:
    """Weight of a page in the search."""
    return next((weight for beginning, weight in BOOSTS.items() if uri.startswith(beginning)), 1.0)


def fill(entry: dict[str, Any]) -> None:
    """Replace ``notebooks/`` and ``reference/api/`` by their pages, and an index by itself and its folder's pages."""
    for title, value in entry.items():
        if isinstance(value, list):
            for inner in value:
                if isinstance(inner, dict):
                    fill(inner)
        elif value == "notebooks/":
            entry[title] = [f"notebooks/{path.stem}.md" for path in notebooks()]
        elif value == "reference/api/":
            entry[title] = [f"reference/api/{name}.md" for name in (*PACKAGES, *NAMES)]
        elif value.endswith("/README.md"):
            folder = (ROOT / "docs" / value).parent
            others = sorted(path.name for path in folder.glob("*.md") if path.name != "README.md")
            entry[title] = [value, *(f"{folder.name}/{name}" for name in others)]


def network_needs(site: Path) -> list[str]:
    """What pages would load from elsewhere, in words."""
    loading = re.compile(r"""<(?:script|img|link|iframe)\b[^>]*?\b(?:src|href)=["']?((?:https?:)?//[^"'\s>]+)""")
    pages = sorted(site.rglob("*.html"))
    return [
        f"{page.relative_to(site)}: loads {address} from the network"
        for page in pages
        for address in loading.findall(page.read_text(encoding="utf-8"))
    ]


def add(files: Files, config: MkDocsConfig, uri: str, content: str) -> None:
    """One generated file."""
    files.append(File.generated(config, uri, content=content))


def notebooks() -> list[Path]:
    """In the order of their names."""
    return sorted(NOTEBOOKS.glob("*.ipynb"))


def home(uri: str) -> Path:
    """The folder of the repository in which a page's links begin."""
    if uri in FROM_THE_ROOT.values():
        return ROOT
    if uri.startswith("notebooks/"):
        return NOTEBOOKS
    return (ROOT / "docs" / uri).parent


def turned(link: str, uri: str, here: Path) -> str:
    """A link of the repository as a link of the site; what leads nowhere stays, and MkDocs reports it."""
    target = (here / link).resolve()
    if not target.is_relative_to(ROOT) or not target.exists():
        return link
    if target.is_dir():
        target = target / "README.md"
    up = "../" * uri.count("/")
    if target.parent == ROOT and target.name in FROM_THE_ROOT:
        return up + FROM_THE_ROOT[target.name]
    if target.suffix == ".ipynb":
        return f"{up}notebooks/{target.stem}.md"
    if target.is_relative_to(ROOT / "docs"):
        return up + target.relative_to(ROOT / "docs").as_posix()
    return f"{up}files/{target.relative_to(ROOT).as_posix()}.txt"


def copied_by(file: File) -> Iterator[str]:
    """Files of the repository, no pages, that a page links to."""
    text = "".join(_FENCED.split(file.content_string)[::2])
    for link, _ in _LINK.findall(text):
        found = turned(link, file.src_uri, home(file.src_uri)).lstrip("./")
        if found.startswith("files/"):
            yield found.removeprefix("files/").removesuffix(".txt")
