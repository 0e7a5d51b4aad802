"""Pages that are made while the site is built: the API, and files outside docs/. See mkdocs.yml."""

import re
from pathlib import Path
from typing import Any

import mermaidx
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "geoorbit_ros"
REPOSITORY = "https://github.com/geoorbit/geoorbit_ros"

OUTSIDE = {
    "README.md": "index.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "benchmarks/README.md": "benchmarks.md",
    "bags/README.md": "bags.md",
    "msg_defs/README.md": "msg_defs.md",
}
"""Files of the repository that become pages of the site."""

LINK = re.compile(r"(\]\(|(?:src|srcset|href)=\")(?!https?:|mailto:|#)([^)\s\"#]+)")
DIAGRAM = re.compile(r"^```mermaid\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LOADS = re.compile(
    r"<(?:script|img|source|iframe)[^>]+src(?:set)?=.?https?://[^ >]*"
    r"|<link(?![^>]+canonical)[^>]+href=.?https?://[^ >]*"
)
"""What a browser would load from another host."""

VIEW = re.compile(r'viewBox="\S+ \S+ (\S+) (\S+)"')
"""Width and height of a drawing."""
SHORT = re.compile(r"<code>([^<]{1,24})</code>")
"""Code in a sentence that even a phone has in one line."""
FIGURES = re.compile(r"<td( [^>]*)?>((?:<strong>)?[^<>A-Za-z]*\d[^<>A-Za-z]*(?:</strong>)?)</td>")
"""Cells of a table with figures and no word."""
RICH = re.compile(r"\[bold\](.*?)\[/bold\]", re.DOTALL)
"""Rich's markup of bold text, in the help texts of the commands."""

LIST = re.compile(r"^  (\w+) --> (.+)$", re.MULTILINE)
WIDE = ("architecture.md", "results.md")
"""Pages with wide tables or drawings: these get the place of the table of contents, too."""

BOOST = {"glossary.md": 8.0, "guide": 2.0, "index.md": 2.0, "api": 0.2, "adr": 0.2}
"""How high a page stands in the search, by how its name begins: what users read comes first."""

diagrams: dict[str, str] = {}
"""Drawn diagrams by file name, also written as files of their own."""

IMAGES = f"{REPOSITORY}/raw/main/docs/"
"""Where the README shows its images from, so that a package index shows them, too."""


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Fill the menu's two lists that follow from the files."""
    assert config.nav
    for section in config.nav:
        for entries in section.values():
            for entry in entries if isinstance(entries, list) else ():
                if "API" in entry:
                    entry["API"] = [{name: page} for name, page, _ in api_pages()]
                if "Decisions" in entry:
                    records = sorted((ROOT / "docs" / "adr").glob("[0-9]*.md"))
                    entry["Decisions"] = ["adr/README.md", *(f"adr/{r.name}" for r in records)]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that do not lie in docs/."""
    for source, page in OUTSIDE.items():
        text = (ROOT / source).read_text(encoding="utf-8")
        content = moved_links(text, ROOT / source, page).replace(IMAGES, "")
        files.append(File.generated(config, page, content=content))
    for _, page, text in api_pages():
        files.append(File.generated(config, page, content=text))
    return files


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Let links to files outside docs/ lead to their pages; draw the diagrams."""
    source = page.file.src_uri
    if source not in OUTSIDE.values() and not source.startswith("api/"):
        markdown = moved_links(markdown, ROOT / "docs" / source, source)
    page.meta["search"] = {"boost": BOOST.get(source.partition("/")[0].partition("-")[0], 1.0)}
    if source in WIDE:
        page.meta["hide"] = ["toc"]
    return DIAGRAM.sub(lambda block: drawn(block[1], source), markdown)


def on_page_content(html: str, **_: Any) -> str:
    """Keep short code and figures on one line; show the commands of help texts as code."""
    html = RICH.sub(r"<code>\1</code>", html)
    html = SHORT.sub(r'<code class="short">\1</code>', html)
    return FIGURES.sub(r'<td\1 class="figures">\2</td>', html)


def on_post_build(config: MkDocsConfig) -> None:
    """Write the diagrams as files; fail if a page loads anything from another host."""
    folder = Path(config.site_dir) / "diagrams"
    folder.mkdir(exist_ok=True)
    for name, svg in diagrams.items():
        alone = VIEW.sub(
            r'\g<0> width="\1" height="\2"', svg.replace(' width="100%"', "", 1), count=1
        )
        (folder / name).write_text(alone, encoding="utf-8")
    for page in sorted(Path(config.site_dir).rglob("*.html")):
        if found := LOADS.search(page.read_text(encoding="utf-8")):
            raise PluginError(f"{page}: loads {found[0]!r} from another host")


def api_pages() -> list[tuple[str, str, str]]:
    """Name, path and Markdown of one page per folder of the package."""
    pages = []
    for folder in sorted({PACKAGE, *(path.parent for path in PACKAGE.rglob("*.py"))}):
        modules = [path for path in sorted(folder.glob("*.py")) if path.name != "__init__.py"]
        if modules:
            name = str(folder.relative_to(ROOT)).replace("/", ".")
            short = name.partition(".")[2] or name
            text = "\n\n".join([f"# {name}", *(f"::: {name}.{path.stem}" for path in modules)])
            pages.append((short, f"api/{short}.md", text + "\n"))
    return pages


def moved_links(text: str, source: Path, page: str) -> str:
    """Rewrite the relative links of `source` for its place `page` in the site.

    Files that are no pages (code, folders) are linked in the repository.
    """

    def moved(match: re.Match[str]) -> str:
        target = (source.parent / match[2]).resolve()
        if not target.exists():
            return match[0]
        inside = str(target.relative_to(ROOT))
        goal = OUTSIDE.get(inside) or inside.removeprefix("docs/")
        if inside in OUTSIDE or (inside.startswith("docs/") and target.suffix != ".py"):
            return match[1] + "../" * page.count("/") + goal
        return f"{match[1]}{REPOSITORY}/blob/main/{inside}"

    return LINK.sub(moved, text)


def drawn(diagram: str, page: str) -> str:
    """Draw a Mermaid diagram as SVG, so that no page loads a script for it.

    A click on it opens the drawing alone, in its full size.
    """
    svg = mermaidx.render(reduced(diagram), theme="neutral").svg()
    name = f"{Path(page).stem}-{len(diagrams)}.svg"
    diagrams[name] = svg
    target = "../" * page.count("/") + f"diagrams/{name}"
    title = "Open the diagram in its full size"
    inline = "".join(svg.splitlines())
    return f'<a class="diagram" href="{target}" title="{title}">{inline}</a>'


def reduced(diagram: str) -> str:
    """Leave out arrows `a --> c` where `a --> b` and `b --> c` say it, for lists `a --> b & c`."""
    edges = {a: set(targets.split(" & ")) for a, targets in LIST.findall(diagram)}
    if not any(len(targets) > 2 for targets in edges.values()):
        return diagram

    def below(name: str) -> set[str]:
        direct = edges.get(name, set())
        return direct.union(*(below(target) for target in direct))

    kept = {a: targets - set().union(*map(below, targets)) for a, targets in edges.items()}
    lines = (f"  {a} --> {' & '.join(sorted(targets))}" for a, targets in kept.items())
    return "\n".join(["graph TD", *lines])
