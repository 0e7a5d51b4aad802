"""The parameter tables of the guide are those of the schemas."""

import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).parents[2] / "docs" / "make_parameter_tables.py"


def test_tables_are_up_to_date() -> None:
    result = subprocess.run(
        [sys.executable, str(SCRIPT), "--check"], capture_output=True, text=True, timeout=240
    )
    assert result.returncode == 0, result.stderr
