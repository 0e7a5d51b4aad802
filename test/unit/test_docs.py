"""Guides point at things that exist."""

import re
from pathlib import Path

import pytest
from typer.main import get_command

from geoorbit_ros.cli.app import app

REPOSITORY = Path(__file__).parents[2]
GUIDES = [
    path
    for folder in (".", "docs", "docs/adr", "bags", "benchmarks", "msg_defs")
    for path in sorted((REPOSITORY / folder).glob("*.md"))
]
LINK = re.compile(r"\]\(([^)\s]+)\)|<(?:img|source)[^>]*(?:src|srcset)=\"([^\"]+)\"")
URL = "https://github.com/geoorbit/geoorbit_ros"
CODE = re.compile(r"```.*?```|`[^`\n]+`", re.DOTALL)


def anchors(text: str) -> set[str]:
    """Anchors of the headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("guide", GUIDES, ids=lambda path: str(path.relative_to(REPOSITORY)))
def test_every_link_leads_somewhere(guide: Path) -> None:
    text = CODE.sub("", guide.read_text(encoding="utf-8"))
    for target in (a or b for a, b in LINK.findall(text)):
        if target.startswith(("http://", "https://", "mailto:")):
            continue
        name, _, anchor = target.partition("#")
        file = guide.parent / name if name else guide
        assert file.exists(), f"{guide.name}: {target}"
        if anchor:
            assert anchor in anchors(file.read_text(encoding="utf-8")), f"{guide.name}: {target}"


def test_every_image_is_shown() -> None:
    texts = "".join(path.read_text(encoding="utf-8") for path in GUIDES)
    images = sorted((REPOSITORY / "docs" / "images").iterdir())
    assert images
    assert [image.name for image in images if image.name not in texts] == []


def test_decisions_are_numbered_without_holes_and_listed() -> None:
    records = sorted((REPOSITORY / "docs" / "adr").glob("[0-9]*.md"))
    assert [path.name[:4] for path in records] == [f"{n:04}" for n in range(1, len(records) + 1)]
    index = (REPOSITORY / "docs" / "adr" / "README.md").read_text(encoding="utf-8")
    for path in records:
        assert path.read_text(encoding="utf-8").startswith(f"# {path.name[:4]}: ")
        assert f"| [{path.name[:4]}]({path.name}) |" in index


def test_images_of_the_readme_are_absolute_and_exist() -> None:
    """A package index shows the README without the repository beside it."""
    text = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    images = re.findall(r"!\[[^\]]*\]\(([^)]+)\)|<img[^>]*src=\"([^\"]+)\"", text)
    assert images
    for image in (a or b for a, b in images):
        assert image.startswith(f"{URL}/raw/main/docs/images/"), image
        assert (REPOSITORY / "docs" / "images" / image.rpartition("/")[2]).exists(), image


def test_project_urls_are_those_of_the_site_and_the_readme() -> None:
    for file in ("setup.cfg", "package.xml", "mkdocs.yml", "docs/site/hooks.py"):
        assert URL in (REPOSITORY / file).read_text(encoding="utf-8"), file


def test_the_readme_lists_the_commands_of_the_help() -> None:
    text = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    rows = text.split("## Commands")[1].split("\n## ")[0].splitlines()
    cells = [row.split("|")[1] for row in rows if row.startswith("| `")]
    listed = [name for cell in cells for name in re.findall(r"`(\w+)`", cell)]
    commands = getattr(get_command(app), "commands", {})
    assert sorted(listed) == sorted(commands)


def test_dev_explains_the_docs_requirements() -> None:
    record = (REPOSITORY / "docs" / "adr" / "0002-dependencies.md").read_text(encoding="utf-8")
    for line in (REPOSITORY / "requirements" / "docs.txt").read_text().splitlines():
        if not line.startswith("#"):
            assert f"`{line.partition('==')[0]}`" in record, line
            assert line in (REPOSITORY / "requirements" / "docs-lock.txt").read_text()


@pytest.mark.parametrize("guide", GUIDES, ids=lambda path: str(path.relative_to(REPOSITORY)))
def test_files_and_commands_that_are_named_exist(guide: Path) -> None:
    text = guide.read_text(encoding="utf-8")
    folders = (REPOSITORY, REPOSITORY / "geoorbit_ros", guide.parent)
    for name in re.findall(r"`((?:[\w-]+/)+[\w-]+\.(?:py|msg))`", text):
        assert any((folder / name).exists() for folder in folders), name
    commands = getattr(get_command(app), "commands", {})
    assert set(re.findall(r"`geoorbit ([a-z]+)", text)) <= set(commands)
