"""SUMO's own netconvert: where it is, and what it writes and says."""

from __future__ import annotations

import re
import shutil
from importlib.util import find_spec
from pathlib import Path

from geoorbit_ros.core.errors import GeoOrbitError

TIME_LIMIT_S = 60.0


class NetworkError(GeoOrbitError):
    """SUMO can't make a network of the given roads."""


def netconvert_path() -> str:
    """Path of SUMO's netconvert.

    Raises:
        NetworkError: SUMO, or one of its Python packages, is not installed.
    """
    install = "SUMO: pip install eclipse-sumo libsumo sumolib"
    for package in ("sumolib", "libsumo"):
        if find_spec(package) is None:
            raise NetworkError("simulator SUMO", f"no Python package '{package}'", install)
    import sumolib

    program = shutil.which(sumolib.checkBinary("netconvert"))
    if program is None:
        raise NetworkError("simulator SUMO", "no program 'netconvert'", install)
    return str(program)


def drop_header(path: Path) -> None:
    """Take away netconvert's comment: it has the time and the paths of this run."""
    text = path.read_text(encoding="utf-8")
    path.write_text(re.sub(r"<!--.*?-->\s*", "", text, count=1, flags=re.DOTALL), encoding="utf-8")


def last_line(text: str) -> str:
    """What a program said last, in one line."""
    lines = text.strip().splitlines()
    return lines[-1].strip()[:300] if lines else "no message"
