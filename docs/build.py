"""``make docs``: guides and API reference as a static site in ``site/``, to be read offline and on a phone.

Guides are the Markdown files of ``docs/`` and of the root; the API reference is made by pdoc from the docstrings, their
formulas as MathML. A link between pages that leads nowhere, a formula that cannot be set and anything that a page would
fetch from the network are errors.
"""

import pkgutil
import re
import shutil
import sys
from collections.abc import Iterable
from pathlib import Path
from unittest.mock import patch

import latex2mathml.converter
import markdown2
import pdoc
import pdoc.docstrings
import pdoc.render

import edgeslam_torch
import edgeslam_torch.train

ROOT = Path(__file__).resolve().parent.parent
GUIDES = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")
EXTRAS = ["tables", "fenced-code-blocks", "header-ids", "code-friendly", "strike"]
ASSETS = {".png", ".jpg", ".svg", ".gif"}

PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title} - EdgeSLAM-Torch</title>
<style>
body {{ max-width: 60rem; margin: 0 auto; padding: 1rem; font: 16px/1.55 system-ui, sans-serif; color: #1f2328; }}
body {{ overflow-wrap: anywhere; }}
nav ul {{ display: flex; flex-wrap: wrap; gap: .2rem 1.1rem; margin: 0 0 1.2rem; padding: 0 0 .6rem; }}
nav ul {{ list-style: none; border-bottom: 1px solid #d0d7de; }}
nav a[aria-current] {{ color: inherit; font-weight: 600; }}
a {{ color: #0a58a6; }} pre {{ background: #f6f8fa; padding: .8rem; overflow-x: auto; }} code {{ font-size: .92em; }}
table {{ border-collapse: collapse; display: block; overflow-x: auto; overflow-wrap: break-word; }}
td, th {{ border: 1px solid #d0d7de; padding: .3rem .6rem; vertical-align: top; }} img {{ max-width: 100%; }}
</style></head><body><nav><ul>{nav}</ul></nav>{body}</body></html>
"""


def main() -> int:
    """Build the site; 1 when something in it is broken."""
    site = ROOT / "site"
    shutil.rmtree(site, ignore_errors=True)
    guides = write_guides(site)
    problems = [problem for guide in guides for problem in broken_links(guide)]
    write_reference(site / "api", modules())
    problems += network_needs(site)
    for problem in problems:
        sys.stderr.write(f"docs: {problem}\n")
    sys.stdout.write(f"docs: {len(guides)} guides and the API reference are in {site / 'index.html'}\n")
    return 1 if problems else 0


def write_guides(site: Path) -> list[Path]:
    """Write every guide as a page, with the pictures that they show; return the guides' files."""
    guides = [ROOT / name for name in GUIDES] + sorted((ROOT / "docs").rglob("*.md"))
    for guide in guides:
        write_guide(site, guide, guides)
    copy_assets(site)
    return guides


def write_reference(target: Path, names: Iterable[str]) -> None:
    """Write the API reference of modules.

    Raises:
        ValueError: If a docstring has a formula that cannot be set.
    """
    convert = pdoc.docstrings.convert

    def with_formulas(docstring: str, docformat: str, source_file: Path | None) -> str:
        return convert(formulas_as_mathml(docstring), docformat, source_file)

    pdoc.render.configure(docformat="google", footer_text="EdgeSLAM-Torch", template_directory=ROOT / "docs" / "pdoc")
    with patch.object(pdoc.docstrings, "convert", with_formulas):
        pdoc.pdoc(*names, output_directory=target)


def formulas_as_mathml(docstring: str) -> str:
    """Docstring with its ``.. math::`` blocks and ``:math:`` roles as MathML, which browsers set by themselves."""
    block = re.compile(r"^( *)\.\. math::(.*(?:\n(?:\1 +\S.*| *(?=\n)))*)", re.MULTILINE)
    text = block.sub(lambda m: f'{m[1]}<span class="formula">{mathml(m[2], "block")}</span>\n', docstring)
    return re.sub(r":math:`([^`]+)`", lambda m: mathml(m[1], "inline"), text)


def mathml(latex: str, display: str) -> str:
    """A formula as MathML, ``display`` inline or block.

    Raises:
        ValueError: If it has a command that is not known.
    """
    found = str(latex2mathml.converter.convert(" ".join(latex.split()), display=display))
    if "\\" in found:
        raise ValueError(f"formula has a command that latex2mathml does not know: {latex}")
    return re.sub(r"(<mi>[a-z]{2,}</mi>)(?=<m[^o])", r'\1<mspace width="0.167em" />', found)  # log s, not logs


def network_needs(site: Path) -> list[str]:
    """What pages would load from elsewhere, in words."""
    loading = re.compile(r"""<(?:script|img|link|iframe)\b[^>]*?\b(?:src|href)=["']?((?:https?:)?//[^"'\s>]+)""")
    pages = sorted(site.rglob("*.html"))
    return [
        f"{page.relative_to(site)}: loads {address} from the network"
        for page in pages
        for address in loading.findall(page.read_text(encoding="utf-8"))
    ]


def modules() -> list[str]:
    """What lies directly in the package; pdoc goes on from there and finds the lazily loaded names resolved."""
    for package in (edgeslam_torch, edgeslam_torch.train):
        for name in package.__all__:
            getattr(package, name)
    found = pkgutil.iter_modules(edgeslam_torch.__path__, "edgeslam_torch.")
    return ["edgeslam_torch", *(module.name for module in found)]


def page_name(guide: Path) -> str:
    """Path of a guide's page, relative to the site."""
    path = guide.relative_to(ROOT)
    return str(path.with_name("index.html") if path.name == "README.md" else path.with_suffix(".html"))


def is_in_menu(guide: Path) -> bool:
    """Whether every page links to a guide; a folder's index links to the pages below it."""
    return guide.name == "README.md" or guide.parent in (ROOT, ROOT / "docs")


def menu_title(guide: Path) -> str:
    """Title of a guide in the menu; of a folder's index, the folder's name."""
    folder = guide.parent.name if guide.name == "README.md" and guide.parent != ROOT else guide.stem
    return folder.replace("_", " ").capitalize()


def write_guide(site: Path, guide: Path, guides: list[Path]) -> None:
    """One guide as a page, with links to the others."""
    target = site / page_name(guide)
    target.parent.mkdir(parents=True, exist_ok=True)
    up = "../" * len(target.parent.relative_to(site).parts)
    links = [(page_name(other), menu_title(other)) for other in guides if is_in_menu(other)]
    here = {page_name(guide): ' aria-current="page"'}
    nav = "\n".join(
        f'<li><a href="{up}{page}"{here.get(page, "")}>{title}</a></li>'
        for page, title in [*links, ("api/index.html", "API")]
    )
    body = str(markdown2.markdown(guide.read_text(encoding="utf-8"), extras=EXTRAS))
    body = re.sub(r'href="([^":]+)\.md(#[^"]*)?"', link_to_page, body)
    target.write_text(PAGE.format(title=menu_title(guide), nav=nav, body=body), encoding="utf-8")


def link_to_page(match: re.Match[str]) -> str:
    """A link to a Markdown file as a link to its page."""
    path = re.sub(r"(^|/)README$", r"\1index", match[1])
    return f'href="{path}.html{match[2] or ""}"'


def copy_assets(site: Path) -> None:
    """Pictures that the guides show."""
    for path in (ROOT / "docs").rglob("*"):
        if path.suffix in ASSETS:
            target = site / path.relative_to(ROOT)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, target)


def broken_links(guide: Path) -> list[str]:
    """Relative links of a guide that lead to no file."""
    text = re.sub(r"```.*?```", "", guide.read_text(encoding="utf-8"), flags=re.S)
    targets = re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text)
    local = [t for t in targets if "://" not in t and not t.startswith("mailto:")]
    return [f"{guide.relative_to(ROOT)}: link to {t} leads nowhere" for t in local if not (guide.parent / t).exists()]


if __name__ == "__main__":
    sys.exit(main())
