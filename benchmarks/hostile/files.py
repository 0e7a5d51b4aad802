"""Attacks by files."""

from __future__ import annotations

import sys
from pathlib import Path

from hostile.harness import Finding, bounded

LIMIT_S, MEMORY_MB = 20.0, 3000

FLEET = """
import sys
from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.core.input_report import InputReport
from geoorbit_ros.fleet.fleet_io import load_fleet
try:
    load_fleet(sys.argv[1], InputReport(sys.argv[1], "cameras", 1))
except GeoOrbitError as error:
    print("refused:", str(error)[:200])
"""
METADATA = """
from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.detection.onnx.session import parse_metadata
for text in ("[" * 100_000, "(" * 5000 + ")" * 5000, "-" * 100_000 + "1", "{1e400: 'car'}"):
    try:
        parse_metadata({"names": text}, "m.onnx")
    except GeoOrbitError:
        pass
print("refused")
"""


def yaml_bomb(folder: Path) -> Finding:
    """Row 19: half a kilobyte of anchors in anchors."""
    lines = ["x-a0: &a0 [" + ", ".join("v" * 9) + "]"]
    lines += [f"x-a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 9)]
    file = folder / "fleet.yaml"
    file.write_text("\n".join([*lines, "cameras: *a8", ""]))
    status, took_s, said = bounded([sys.executable, "-c", FLEET, str(file)], LIMIT_S, MEMORY_MB)
    sound = status == 0 and "refused" in said
    last = said.strip().splitlines()[-1][:60] if said.strip() else f"status {status}"
    outcome = f"refused in {took_s:.1f} s" if sound else f"{last} after {took_s:.0f} s"
    what = f"{file.stat().st_size} bytes: {outcome}"
    return Finding("19: YAML bomb", float(not sound), what)


def onnx_metadata(_: Path) -> Finding:
    """Row 19: metadata that exhaust Python's parser."""
    status, _s, said = bounded([sys.executable, "-c", METADATA], LIMIT_S, MEMORY_MB)
    sound = status == 0 and "refused" in said
    last = said.strip().splitlines()[-1][:60] if said.strip() else f"status {status}"
    return Finding("19: ONNX metadata", float(not sound), "refused" if sound else last)


ATTACKS = (yaml_bomb, onnx_metadata)
