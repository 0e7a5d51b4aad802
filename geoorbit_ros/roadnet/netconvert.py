"""Runs netconvert, the program of SUMO that makes road networks."""

from __future__ import annotations

import re
import shutil
import subprocess
from importlib.util import find_spec
from pathlib import Path

from geoorbit_ros.core.errors import RoadNetworkError

TIME_LIMIT_S = 600.0
"""Chosen: larger for extracts of whole cities; smaller ends a netconvert that hangs earlier."""


def netconvert_path() -> str:
    """Path of SUMO's netconvert.

    Raises:
        RoadNetworkError: SUMO, or one of its Python packages, is not installed.
    """
    install = "SUMO: pip install eclipse-sumo libsumo sumolib"
    for package in ("sumolib", "libsumo"):
        if find_spec(package) is None:
            raise RoadNetworkError("simulator SUMO", f"no Python package '{package}'", install)
    import sumolib

    program = shutil.which(sumolib.checkBinary("netconvert"))
    if program is None:
        raise RoadNetworkError("simulator SUMO", "no program 'netconvert'", install)
    return str(program)


def netconvert(arguments: list[str], place: str, folder: Path | None = None) -> tuple[str, ...]:
    """Run netconvert and return its warnings, without "Warning: ".

    Args:
        arguments: Without the program.
        place: What it works on, for errors.
        folder: Relative paths in the arguments start here; default: the current folder.

    Raises:
        RoadNetworkError: SUMO is not installed, or netconvert ends with an error or not at all.
    """
    try:
        done = subprocess.run(
            [netconvert_path(), *arguments],
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=TIME_LIMIT_S,
        )
    except subprocess.TimeoutExpired as error:
        found = f"netconvert still at work after {TIME_LIMIT_S:g} s"
        raise RoadNetworkError(place, found, "a smaller area") from error
    said = [line.strip() for line in done.stderr.splitlines()]
    if done.returncode != 0:
        errors = [line.removeprefix("Error: ") for line in said if line.startswith("Error:")]
        found = f"netconvert says: {errors[0][:300] if errors else last_line(done.stderr)}"
        raise RoadNetworkError(place, found, "a map that netconvert takes")
    return tuple(line.removeprefix("Warning: ") for line in said if line.startswith("Warning:"))


def netconvert_version() -> str:
    """Name and version, as netconvert states them.

    Raises:
        RoadNetworkError: SUMO is not installed.
    """
    done = subprocess.run(
        [netconvert_path(), "--version"], capture_output=True, text=True, timeout=TIME_LIMIT_S
    )
    return done.stdout.splitlines()[0].strip() if done.stdout else "unknown"


def drop_header(path: Path) -> None:
    """Remove the comment with the time and the paths of this run that netconvert writes."""
    text = path.read_text(encoding="utf-8")
    path.write_text(re.sub(r"<!--.*?-->\s*", "", text, count=1, flags=re.DOTALL), encoding="utf-8")


def last_line(text: str) -> str:
    """The last line of a program's output, at most 300 characters."""
    lines = text.strip().splitlines()
    return lines[-1].strip()[:300] if lines else "no message"
