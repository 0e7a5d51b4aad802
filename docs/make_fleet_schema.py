"""Writes params/fleets/fleet.schema.json, with which editors check and complete fleet files.

.venv/bin/python docs/make_fleet_schema.py            # rewrites it
.venv/bin/python docs/make_fleet_schema.py --check    # exit 1 if it is not up to date
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from geoorbit_ros.fleet.fleet_file import Fleet

FILE = Path(__file__).parents[1] / "params" / "fleets" / "fleet.schema.json"


def main() -> int:
    """Rewrite or check the schema."""
    text = json.dumps(Fleet.model_json_schema(), indent=1, ensure_ascii=False) + "\n"
    if "--check" in sys.argv[1:]:
        return int(not FILE.exists() or FILE.read_text(encoding="utf-8") != text)
    FILE.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
