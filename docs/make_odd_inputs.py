"""Writes docs/odd-inputs.md: what each reader does with the odd files that the tests have.

.venv/bin/python docs/make_odd_inputs.py            # rewrites it
.venv/bin/python docs/make_odd_inputs.py --check    # exit 1 if it is not up to date
"""

from __future__ import annotations

import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.lanes.geojson import read_lane_file
from geoorbit_ros.roadnet.osm_extract import read_extract
from geoorbit_ros.storage.track_bag import read_track_bag

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "odd-inputs.md"
LONGEST = 260
"""Characters of an outcome that are shown. Chosen: the end of a long one is advice."""
HEAD = """\
# Odd files

What the readers do with files that are not as documented. Of those below,

- {used} are *used*: they are read as they are meant, and there is nothing to say;
- {told} are *told*: they are read, and what was repaired or left out is said, with its number and
  the first example, on the console, in the report and on `/diagnostics`. `--strict` refuses them;
- {refused} are *refused* in one sentence: nothing sensible can be made of them.

`docs/make_odd_inputs.py` writes this page: it gives the files of the tests to the readers.
"""
Entry = tuple[str, Callable[[Path], str]]
"""What is odd about a file; reads it in a folder and gives what was told."""


def tests(name: str) -> Any:
    """A module of the tests, with the odd files in it."""
    return import_module(f"unit.{name}")


def sections() -> Iterator[tuple[str, Iterator[Entry]]]:
    """Title and entries of each table."""
    yield "Track files", track_files()
    yield "Control points", control_points()
    yield "Bags", bags()
    yield "Lane files", lane_files()
    yield "OpenStreetMap extracts", extracts()
    yield "Fleet files", fleets()
    yield "ONNX models", models()


def track_files() -> Iterator[Entry]:
    """Spellings, times, single rows, formats and files that are none."""
    t = tests("storage.test_track_files")

    def entry(content: str | bytes, **options: object) -> Callable[[Path], str]:
        return lambda folder: t.said(t.read(folder, content, image_size=t.SIZE, **options)[1])

    for name, (write, _, _) in t.TIMES.items():
        content = t.each(lambda d, w=write: [d["id"], w(d["time"]), *list(d.values())[2:]])
        yield f"times: {name}", entry(content)
    for name, content in t.SPELLINGS.items():
        yield name, entry(content)
    for name, (content, _) in t.ONE_ROW.items():
        yield f"one row: {name}", entry(content)
    for name, (content, _) in t.FORMATS.items():
        yield name, entry(content, fps=t.FPS)
    for name, (content, _) in t.REFUSED.items():
        yield name, entry(content)


def control_points() -> Iterator[Entry]:
    """Spellings, other coordinates, single lines and files that fix no plane."""
    t = tests("calibration.test_control_points")

    def entry(content: str | bytes, **options: object) -> Callable[[Path], str]:
        return lambda folder: t.said(t.read(folder, content, **options))

    for name, content in t.SPELLINGS.items():
        yield name, entry(content)
    for name, (content, _) in t.ELSEWHERE.items():
        yield name, entry(content, image_size=(1920, 1080))
    for name, (content, _, _) in t.LEFT_OUT.items():
        yield f"one line: {name}", entry(content)
    for name, (content, _) in t.REFUSED.items():
        yield name, entry(content)


def bags() -> Iterator[Entry]:
    """MCAP files of other programs, and bags with a part or metadata missing."""
    t = tests("storage.test_odd_bags")

    def written(made: Any, messages: Any) -> Callable[[Path], str]:
        return lambda folder: t.told(read_track_bag(made.write(folder / "a.mcap", messages)))

    def parts(change: Callable[[Path], None]) -> Callable[[Path], str]:
        def read(folder: Path) -> str:
            bag = t.split_bag(folder)
            change(bag)
            return str(t.told(read_track_bag(bag)))

        return read

    for name, made in t.WELL:
        yield name, written(made, t.MESSAGES)
    for encoding, channel in t.FOREIGN.items():
        alone = t.MadeMcap({1: channel}, profile="")
        yield f"messages in {encoding}", written(alone, [(1, k, b"{}") for k in range(5)])
    for name, change, _, _ in t.PARTS:
        yield f"in parts: {name}", parts(change)


def lane_files() -> Iterator[Entry]:
    """GeoJSON of other programs."""
    t = tests("lanes.test_geojson")

    def entry(change: Callable[[Any], Any]) -> Callable[[Path], str]:
        def read(folder: Path) -> str:
            path = t.put(folder / "lanes.geojson", change(t.collection()))
            return " | ".join(read_lane_file(path).report.sentences())

        return read

    for name, change, _ in [*t.SAME, *t.WRONG]:
        yield name, entry(change)


def extracts() -> Iterator[Entry]:
    """What editors, servers and other programs make of an extract."""
    t = tests("roadnet.test_osm_extract")

    def entry(content: str | bytes) -> Callable[[Path], str]:
        return lambda folder: " | ".join(
            read_extract(t.write(folder / "area.osm", content)).report.sentences()
        )

    for name, (content, _) in [*t.GOOD.items(), *t.BAD.items()]:
        yield name, entry(content)


def fleets() -> Iterator[Entry]:
    """Fleet files as people write them."""
    t = tests("fleet.test_odd_fleets")

    def entry(content: str | bytes) -> Callable[[Path], str]:
        return lambda folder: str(t.read(folder, content)[1])

    for name, content, _ in t.SAME:
        yield name, entry(content)
    for old, new, _, _ in t.LEFT_OUT:
        if new != "- south":
            yield f"`{code(new)}` for `{code(old)}`", entry(t.GOOD.replace(old, new, 1))
    for content, _ in t.REFUSED:
        yield f"`{code(content[:40])}`", entry(content)


def models() -> Iterator[Entry]:
    """Outputs that can't be understood."""
    t = tests("detection.test_onnx_layouts")

    def entry(outputs: list[Any], names: dict[int, str] | None) -> Callable[[Path], str]:
        def read(folder: Path) -> str:
            arrays = [output.astype("float32") for output in outputs]
            said = None if names is None else {"names": names}
            canvas = (t.SIDE, t.SIDE)
            t.OnnxYolo(t.constant_model(folder / "m.onnx", *arrays, canvas=canvas, metadata=said))
            return ""

        return read

    for name, outputs, names, _ in t.REFUSED:
        yield name, entry(outputs, names)


def outcome(read: Callable[[Path], str]) -> tuple[str, str]:
    """`used`, `told` or `refused`, and the words."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            words = read(Path(folder))
            kind = "told" if words else "used"
        except GeoOrbitError as error:
            kind, words = "refused", str(error)
        return kind, words.replace(f"{folder}/", "")


def code(text: str) -> str:
    """One line for a table's cell."""
    line = re.sub(r"\s+", " ", text.replace("|", "\\|").replace("`", "'")).strip()
    return "".join(c if c.isprintable() else f"\\x{ord(c):02x}" for c in line) or " "


def page() -> str:
    """The whole page."""
    count = {"used": 0, "told": 0, "refused": 0}
    lines = []
    for title, entries in sections():
        lines += ["", f"## {title}", "", "| file | outcome | what is said |", "|---|---|---|"]
        for name, read in entries:
            kind, words = outcome(read)
            count[kind] += 1
            short = words if len(words) <= LONGEST else words[:LONGEST].rpartition(" ")[0] + " …"
            lines.append(f"| {code(name)} | {kind} | {code(short).replace('<', '&lt;')} |")
    return HEAD.format(**count) + "\n".join(lines) + "\n"


def main() -> int:
    """Rewrite or check docs/odd-inputs.md."""
    sys.path[:0] = [str(ROOT), str(ROOT / "test")]
    sys.path += [str(folder) for folder in (ROOT / "test" / "unit").iterdir() if folder.is_dir()]
    text = page()
    if "--check" in sys.argv:
        return int(text != PAGE.read_text(encoding="utf-8"))
    PAGE.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
