"""`geoorbit demo` as a newcomer runs it: a process, the real nodes, a page at the end."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from geoorbit_ros.lanes.geojson import read_lane_file


def test_the_demo_finds_every_lane_and_writes_its_page(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    done = subprocess.run(
        [sys.executable, "-m", "geoorbit_ros.cli.main", "demo", "--out", out, "--rate", "0"],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "4 of 4 lanes found, 4 of them confirmed; 0 invented" in done.stdout
    assert (out / "report.html").resolve().as_uri() in done.stdout
    lanes = read_lane_file(out / "lanes.geojson")
    assert len(lanes.lane_map.confirmed) == 4
    assert "Compared with the true lanes" in (out / "report.html").read_text(encoding="utf-8")
