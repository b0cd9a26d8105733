"""What MkDocs does not do by itself: pages from files outside ``docs/``, notebooks, and the API's list of modules.

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

FROM_THE_ROOT = {"README.md": "index.md"} | {
    f"{name}.md": f"{name}.md" for name in ("CHANGELOG", "CONTRIBUTING", "SECURITY")
}
"""Files at the root, and the pages that they become."""
LINKED_FOLDERS = ("models", "losses", "train", "eval")
NOTEBOOKS = ROOT / "examples" / "notebooks"
INTERNAL = ("commands", "help", "jobs", "cli", "command_line", "console", "run_summary", "states", "eval.judge")
"""Parts of the package that a user neither imports nor reads about: their pages are there, but not searched."""
_GUIDES_FIRST, _RECORDS_LAST = 4.0, 0.5
"""Weights of pages in the search; those of the API have 1."""
_LINK = re.compile(r"(?<=\]\()([^)#\s:]+)(#[^)\s]*)?(?=\))")
_FENCED = re.compile(r"(^```.*?^```)", re.MULTILINE | re.DOTALL)


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Fill the menu: notebooks, modules, a folder's pages below its index, and guides that it does not name."""
    menu = config.nav or []
    named = str(menu)
    for entry in menu:
        if "Guides" in entry:
            guides = sorted(path.name for path in (ROOT / "docs").glob("*.md"))
            entry["Guides"] += [name for name in guides if f"'{name}'" not in named]
        if "Notebooks" in entry:
            entry["Notebooks"] = [f"notebooks/{path.stem}.md" for path in notebooks()]
        if "API" in entry:
            entry["API"] = menu_of(modules())
        unfold(entry)
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
    for module in modules():
        add(files, config, api_page(module), f"::: {module}\n")
    for name in sorted({name for file in files.documentation_pages() for name in copied_by(file)}):
        add(files, config, f"files/{name}.txt", (ROOT / name).read_text(encoding="utf-8"))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links to where their pages are, set formulas, weigh the page for the search."""
    page.meta["search"] = searched(page.file.src_uri)
    markdown = fenced_as_mathml(markdown)
    here = home(page.file.src_uri)
    parts = _FENCED.split(markdown)
    parts[::2] = [
        _LINK.sub(lambda m: turned(m[1], page.file.src_uri, here) + (m[2] or ""), text) for text in parts[::2]
    ]
    return "".join(parts)


def searched(uri: str) -> dict[str, Any]:
    """How the search treats a page."""
    if uri.startswith("api/"):
        module = uri.removeprefix("api/edgeslam_torch/").removesuffix(".md").removesuffix("/index").replace("/", ".")
        return {"exclude": any(module == name or module.startswith(f"{name}.") for name in INTERNAL)}
    records = uri == "CHANGELOG.md" or uri.startswith("decisions/")
    return {"boost": _RECORDS_LAST if records else _GUIDES_FIRST}


def unfold(entry: dict[str, Any]) -> None:
    """Replace an index, ``folder/README.md``, by itself and the other pages of its folder."""
    for title, value in entry.items():
        if isinstance(value, list):
            for inner in value:
                if isinstance(inner, dict):
                    unfold(inner)
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
    if not target.is_relative_to(ROOT) or not target.exists() or uri.startswith("api/"):
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
    if file.src_uri.startswith("api/"):
        return
    text = "".join(_FENCED.split(file.content_string)[::2])
    for link, _ in _LINK.findall(text):
        found = turned(link, file.src_uri, home(file.src_uri)).lstrip("./")
        if found.startswith("files/"):
            yield found.removeprefix("files/").removesuffix(".txt")


def modules() -> list[str]:
    """Every module of the package that a reader may import, by its full name."""
    package = ROOT / "edgeslam_torch"
    found = {path.relative_to(ROOT) for path in package.rglob("*.py")}
    for folder in LINKED_FOLDERS:  # links in most checkouts, nothing in some
        found |= {Path("edgeslam_torch") / path.relative_to(ROOT) for path in (ROOT / folder).rglob("*.py")}
    names = {".".join(path.with_suffix("").parts).removesuffix(".__init__") for path in found}
    return sorted(name for name in names if "._" not in name)


def api_page(module: str) -> str:
    """Where a module's page is; a package's is the index of its folder."""
    path = ROOT / Path(*module.split("."))
    own = ROOT / Path(*module.split(".")[1:])
    return f"api/{module.replace('.', '/')}" + ("/index.md" if path.is_dir() or own.is_dir() else ".md")


def menu_of(names: list[str]) -> list[Any]:
    """Nested menu, packages before the modules in them."""
    tree: dict[str, Any] = {}
    for name in names:
        at = tree
        for part in name.split("."):
            at = at.setdefault(part, {})
    return entries("edgeslam_torch", tree["edgeslam_torch"])


def entries(name: str, tree: dict[str, Any]) -> list[Any]:
    """Menu of one package."""
    inner = [
        {part: entries(f"{name}.{part}", below) if below else api_page(f"{name}.{part}")}
        for part, below in tree.items()
    ]
    return [api_page(name), *inner]
