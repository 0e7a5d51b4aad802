"""The pages that scripts write are those that the scripts would write now."""

import subprocess
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.parametrize("script", ["make_parameter_tables.py", "make_odd_inputs.py"])
def test_pages_are_up_to_date(script: str) -> None:
    result = subprocess.run(
        [sys.executable, str(DOCS / script), "--check"], capture_output=True, text=True, timeout=600
    )
    assert result.returncode == 0, result.stderr or f"run docs/{script}"
