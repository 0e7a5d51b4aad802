"""Files that ship with the package: parameter schemas, scenes, message definitions."""

from __future__ import annotations

import sys
from pathlib import Path

from geoorbit_ros.core.errors import InputFileError

PACKAGE = "geoorbit_ros"


def share_path(relative: str) -> Path:
    """Path of a shipped file, in a source checkout or after `pip install` or `colcon build`.

    Args:
        relative: Path below the share folder, such as `params/scenes/lane_drop.yaml`.

    Raises:
        InputFileError: No such file is installed.
    """
    here = Path(__file__).resolve()
    # Checkout; colcon's install/<pkg>/lib/pythonX/site-packages; a virtual environment's prefix.
    roots = [here.parents[2], *(p / "share" / PACKAGE for p in here.parents)]
    roots.append(Path(sys.prefix) / "share" / PACKAGE)
    for root in roots:
        if (root / relative).exists():
            return root / relative
    raise InputFileError(f"share folder of {PACKAGE}", f"no '{relative}'", "an installed file")


def shipped_names(folder: str) -> list[str]:
    """Names of the YAML files that ship in a folder of the share folder."""
    return sorted(file.stem for file in share_path(folder).glob("*.yaml"))


def file_or_shipped(path: str | Path, folder: str, kind: str) -> Path:
    """A file as it is; for a bare name the shipped YAML file of that name.

    Args:
        path: The file or the name.
        folder: Below the share folder, such as `params/scenes`.
        kind: What such a file holds, for errors: "scene".

    Raises:
        InputFileError: A bare name that is neither a file nor shipped.
    """
    file = Path(path)
    if file.suffix or str(path) != file.name or file.is_file():
        return file
    if file.name not in (names := shipped_names(folder)):
        expected = f"a file, or one of {', '.join(names)}"
        raise InputFileError(f"{kind} '{path}'", f"no such {kind}", expected)
    return share_path(f"{folder}/{path}.yaml")
