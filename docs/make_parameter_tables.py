"""Writes the parameter tables of docs/ros.md from the schemas params/<node>.yaml.

.venv/bin/python docs/make_parameter_tables.py            # rewrites them
.venv/bin/python docs/make_parameter_tables.py --check    # exit 1 if they are not up to date
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from geoorbit_ros.parameters import ParameterSpec, load_schema

GUIDE = Path(__file__).parent / "ros.md"
BLOCK = re.compile(r"<!-- parameters of (\w+) -->\n.*?<!-- end -->", re.DOTALL)


def table(node: str) -> str:
    """The parameters of one node as a Markdown table between its marks."""
    rows = [
        f"| `{s.name}` | {default(s)} | {s.expected}{'' if s.read_only else ' ✎'} "
        f"| {s.description.replace('<', '&lt;')} |"
        for s in load_schema(node)
    ]
    head = ["| parameter | default | value | meaning |", "|---|---|---|---|"]
    return "\n".join([f"<!-- parameters of {node} -->", *head, *rows, "<!-- end -->"])


def default(spec: ParameterSpec) -> str:
    """The default as one would write it on the command line."""
    if isinstance(spec.default, bool):
        return f"`{str(spec.default).lower()}`"
    if spec.default == "":
        return "**needed**" if spec.not_empty else "empty"
    return f"`{spec.default}`"


def main() -> int:
    """Rewrite or check docs/ros.md."""
    old = GUIDE.read_text(encoding="utf-8")
    new = BLOCK.sub(lambda match: table(match.group(1)), old)
    if "--check" in sys.argv[1:]:
        if new != old:
            print(f"{GUIDE}: run docs/make_parameter_tables.py", file=sys.stderr)
        return int(new != old)
    GUIDE.write_text(new, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
