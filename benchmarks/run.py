"""Runs the benchmark scripts beside this file and prints their ratios in one table.

How a script reports is in README.md. The exit status is 1 when a script failed or a ratio is over
its limit, 0 otherwise.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

FOLDER = Path(__file__).parent
BASELINES = FOLDER / "baselines"
TIME_LIMIT_S = 1800.0


@dataclass(frozen=True)
class Result:
    """One line that a script printed.

    Attributes:
        name: What is compared with what.
        ratio: Its cost divided by its peer's; None when it was skipped.
        limit: The largest acceptable ratio; None when it is only watched.
        skipped: Why there is no ratio; empty otherwise.
    """

    name: str
    ratio: float | None = None
    limit: float | None = None
    skipped: str = ""

    @property
    def over(self) -> bool:
        """Whether the ratio breaks its limit; not a number does."""
        return self.ratio is not None and self.limit is not None and not self.ratio <= self.limit


def run_script(path: Path) -> list[Result]:
    """Run one script; its progress on standard error passes through.

    Raises:
        subprocess.CalledProcessError: The script failed.
        subprocess.TimeoutExpired: It took longer than `TIME_LIMIT_S`.
    """
    done = subprocess.run(
        [sys.executable, str(path)],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        timeout=TIME_LIMIT_S,
    )
    return [Result(**json.loads(line)) for line in done.stdout.splitlines() if line[:1] == "{"]


def read_baseline(script: str) -> dict[str, float]:
    """Ratios of the last accepted run by name; empty when there was none."""
    path = BASELINES / f"{script}.json"
    baseline: dict[str, float] = json.loads(path.read_text()) if path.exists() else {}
    return baseline


def write_baseline(script: str, results: list[Result]) -> None:
    """Accept the ratios of this run; skipped ones keep their old value."""
    ratios = {r.name: round(r.ratio, 3) for r in results if r.ratio is not None}
    text = json.dumps(read_baseline(script) | ratios, indent=2, ensure_ascii=False)
    BASELINES.mkdir(exist_ok=True)
    (BASELINES / f"{script}.json").write_text(text + "\n")


def add_rows(table: Table, script: str, results: list[Result]) -> None:
    """One row per ratio, with the accepted one beside it."""
    baseline = read_baseline(script)
    for result in results:
        accepted = baseline.get(result.name)
        verdict = result.skipped or ("[red]over its limit" if result.over else "ok")
        table.add_row(
            script,
            result.name,
            "" if result.ratio is None else f"{result.ratio:.3g}",
            "" if accepted is None else f"{accepted:.3g}",
            "" if result.limit is None else f"{result.limit:.3g}",
            verdict,
        )


def main() -> int:
    """Run the chosen scripts, print the table, and return the exit status."""
    scripts = {p.stem: p for p in sorted(FOLDER.glob("*.py")) if p != Path(__file__)}
    parser = argparse.ArgumentParser(prog="./dev bench", description=__doc__)
    listed = f"of {', '.join(scripts)}; default: those with a baseline"
    parser.add_argument("script", nargs="*", help=listed)
    parser.add_argument("--update", action="store_true", help="accept the ratios as baseline")
    options = parser.parse_args()
    if unknown := set(options.script) - set(scripts):
        parser.error(f"no benchmark is called {', '.join(sorted(unknown))}")

    console = Console()
    table = Table("script", "measure", "ratio", "baseline", "limit", "")
    failed = False
    accepted = [name for name in scripts if (BASELINES / f"{name}.json").exists()]
    for script in options.script or accepted:
        console.print(f"[dim]running {script} …")
        try:
            results = run_script(scripts[script])
        except (subprocess.SubprocessError, json.JSONDecodeError, TypeError) as error:
            table.add_row(script, "", "", "", "", f"[red]failed: {error}")
            failed = True
            continue
        add_rows(table, script, results)
        failed |= any(result.over for result in results)
        if options.update:
            write_baseline(script, results)
    console.print(table)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
