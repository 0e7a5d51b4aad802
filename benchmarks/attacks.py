"""Attacks nodes in processes of their own and prints what each attack hurt: 0 is nothing.

On this machine alone: nothing leaves the loopback interface. `--tree` attacks another checkout, to
compare: `python benchmarks/attacks.py --tree ../before`.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).parent


def main() -> int:
    """Run the attacks that were asked for, by default all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("attack", nargs="*", help="names of attacks; default: all")
    parser.add_argument("--tree", type=Path, default=HERE.parent, help="the checkout attacked")
    options = parser.parse_args()
    tree = str(options.tree.resolve())
    if os.environ.get("PYTHONPATH", "").split(":")[0] != tree:
        os.environ["PYTHONPATH"] = f"{tree}:{HERE}"
        os.execv(sys.executable, [sys.executable, str(Path(__file__).resolve()), *sys.argv[1:]])
    sys.path = [path for path in sys.path if path != str(HERE)]
    sys.path[:0] = [tree, str(HERE)]
    from hostile import database, federation, files, harness

    harness.use_free_domain()
    known = {a.__name__: a for part in (files, database, federation) for a in part.ATTACKS}
    if unknown := set(options.attack) - set(known):
        parser.error(f"no attack {', '.join(sorted(unknown))}; there are {', '.join(known)}")
    for name in options.attack or known:
        with tempfile.TemporaryDirectory() as folder:
            try:
                found = known[name](Path(folder))
            except Exception as error:  # an attack that could not be made is no attack survived
                found = harness.Finding(name, float("nan"), f"{type(error).__name__}: {error}")
        print(f"{found.row:45} {found.damage:6.3f}  {found.what}", file=sys.stderr)
        limit = 0.1 if name == "rubbish" else 0.0
        row = {"name": f"damage of {found.row}: {found.what}", "ratio": found.damage}
        print(json.dumps(row | {"limit": limit}), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
