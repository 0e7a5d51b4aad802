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
