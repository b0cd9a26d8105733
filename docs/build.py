"""``make docs``: guides and API reference as a static site in ``site/``; a broken link between pages is an error.

Guides are the Markdown files of ``docs/`` and of the root; the API reference is made by pdoc from the docstrings.
"""

import pkgutil
import re
import shutil
import sys
from pathlib import Path

import markdown2
import pdoc
import pdoc.render

import edgeslam_torch

ROOT = Path(__file__).resolve().parent.parent
SITE = ROOT / "site"
GUIDES = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")
EXTRAS = ["tables", "fenced-code-blocks", "header-ids", "code-friendly", "strike"]
ASSETS = {".png", ".jpg", ".svg", ".gif"}

PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title} - EdgeSLAM-Torch</title>
<style>
body {{ max-width: 60rem; margin: 0 auto; padding: 1rem; font: 16px/1.55 system-ui, sans-serif; color: #1f2328; }}
nav {{ border-bottom: 1px solid #d0d7de; padding-bottom: .6rem; margin-bottom: 1.2rem; }}
nav a {{ margin-right: 1rem; }} a {{ color: #0a58a6; }}
pre {{ background: #f6f8fa; padding: .8rem; overflow-x: auto; }} code {{ font-size: .92em; }}
table {{ border-collapse: collapse; display: block; overflow-x: auto; }}
td, th {{ border: 1px solid #d0d7de; padding: .3rem .6rem; vertical-align: top; }} img {{ max-width: 100%; }}
</style></head><body><nav>{nav}</nav>{body}</body></html>
"""


def main() -> int:
    """Build the site; 1 when a link leads nowhere."""
    shutil.rmtree(SITE, ignore_errors=True)
    SITE.mkdir()
    guides = [ROOT / name for name in GUIDES] + sorted((ROOT / "docs").glob("*.md"))
    broken = [problem for guide in guides for problem in broken_links(guide)]
    for guide in guides:
        write_guide(guide, guides)
    copy_assets()
    pdoc.render.configure(docformat="google", math=True, footer_text="EdgeSLAM-Torch")
    pdoc.pdoc(*modules(), output_directory=SITE / "api")
    for problem in broken:
        sys.stderr.write(f"docs: {problem}\n")
    sys.stdout.write(f"docs: {len(guides)} guides and the API reference are in {SITE / 'index.html'}\n")
    return 1 if broken else 0


def modules() -> list[str]:
    """What lies directly in the package; pdoc goes on from there and finds the lazily loaded names resolved."""
    for name in edgeslam_torch.__all__:
        setattr(edgeslam_torch, name, getattr(edgeslam_torch, name))
    found = pkgutil.iter_modules(edgeslam_torch.__path__, "edgeslam_torch.")
    return ["edgeslam_torch", *(module.name for module in found)]


def page_name(guide: Path) -> str:
    """Where a guide goes, relative to the site."""
    return "index.html" if guide.name == "README.md" else str(guide.relative_to(ROOT).with_suffix(".html"))


def write_guide(guide: Path, guides: list[Path]) -> None:
    """One guide as a page, with links to the others."""
    target = SITE / page_name(guide)
    target.parent.mkdir(parents=True, exist_ok=True)
    up = "" if target.parent == SITE else "../"
    links = [(page_name(other), other.stem.replace("_", " ").capitalize()) for other in guides]
    nav = "".join(f'<a href="{up}{page}">{title}</a>' for page, title in [*links, ("api/index.html", "API")])
    body = str(markdown2.markdown(guide.read_text(encoding="utf-8"), extras=EXTRAS))
    body = re.sub(r'href="([^":]+)\.md(#[^"]*)?"', link_to_page, body)
    target.write_text(PAGE.format(title=guide.stem, nav=nav, body=body), encoding="utf-8")


def link_to_page(match: re.Match[str]) -> str:
    """A link to a Markdown file as a link to its page."""
    path = "index" if match[1].split("/")[-1] == "README" else match[1]
    return f'href="{path}.html{match[2] or ""}"'


def copy_assets() -> None:
    """Pictures that the guides show."""
    for path in (ROOT / "docs").rglob("*"):
        if path.suffix in ASSETS:
            target = SITE / path.relative_to(ROOT)
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
