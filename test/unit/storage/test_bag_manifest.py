"""Every bag of the repository is what `bags/manifest.yaml` says, and nothing else lies there."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import pytest
import yaml

BAGS = Path(__file__).parents[3] / "bags"
ABOUT = {"manifest.yaml", "README.md"}
LICENCES = {"Apache-2.0", "CC0-1.0", "CC-BY-4.0"}
MAX_BYTES = 2_000_000


def faults(folder: Path) -> list[str]:
    """What is wrong with a folder of bags, in sentences."""
    entries: list[dict[str, Any]] = yaml.safe_load((folder / "manifest.yaml").read_text())["bags"]
    found, listed = [], set()
    for entry in entries:
        name = entry.get("name", "?")
        for key in ("name", "what", "how", "licence", "files"):
            if not entry.get(key):
                found.append(f"{name}: no '{key}'")
        if entry.get("licence") not in LICENCES:
            found.append(f"{name}: licence {entry.get('licence')}")
        for file, digest in (entry.get("files") or {}).items():
            path = folder / name / file
            listed.add(path)
            if not path.is_file():
                found.append(f"{name}/{file}: missing")
            elif hashlib.sha256(path.read_bytes()).hexdigest() != digest:
                found.append(f"{name}/{file}: another sha256")
            elif path.stat().st_size > MAX_BYTES:
                found.append(f"{name}/{file}: larger than {MAX_BYTES} bytes")
    there = {p for p in folder.rglob("*") if p.is_file()} - {folder / name for name in ABOUT}
    found += [f"{path.relative_to(folder)}: not listed" for path in sorted(there - listed)]
    return found


def test_the_bags_are_as_listed() -> None:
    assert faults(BAGS) == []


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda bag: (bag / "a.mcap").write_bytes(b"changed"), "bag/a.mcap: another sha256"),
        (lambda bag: (bag / "a.mcap").unlink(), "bag/a.mcap: missing"),
        (lambda bag: (bag / "b.mcap").touch(), "bag/b.mcap: not listed"),
    ],
)
def test_a_difference_is_found(tmp_path: Path, change: Any, fault: str) -> None:
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "a.mcap").write_bytes(b"content")
    entry = {
        "name": "bag",
        "what": "a bag",
        "how": "by hand",
        "licence": "Apache-2.0",
        "files": {"a.mcap": hashlib.sha256(b"content").hexdigest()},
    }
    (tmp_path / "manifest.yaml").write_text(yaml.safe_dump({"bags": [entry]}))
    assert faults(tmp_path) == []
    change(tmp_path / "bag")
    assert faults(tmp_path) == [fault]
