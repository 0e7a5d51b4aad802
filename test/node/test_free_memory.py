"""A process gives back what it does not use, and no more often than it should."""

import subprocess
import sys

from geoorbit_ros.nodes.support.fleet_process import FreeMemory

# Ten thousand blocks of 10 kB, of which each hundredth stays: the heap's end is never free.
PROGRAM = """
from pathlib import Path
from geoorbit_ros.nodes.support.fleet_process import FreeMemory

def resident_mb():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6

memory = FreeMemory(period_s=0.0)
before = resident_mb()
blocks = [bytes(10_000) for _ in range(10_000)]
kept = blocks[::100]
del blocks
scattered = resident_mb()
assert memory.give_back_if_due()
print(before, scattered, resident_mb())
"""


def test_scattered_free_pages_go_back_to_the_system() -> None:
    run = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True
    )
    before, scattered, after = map(float, run.stdout.split())
    assert scattered - before > 90.0  # else there is nothing to give back
    assert after - before < 10.0


def test_not_before_it_is_time() -> None:
    memory = FreeMemory(period_s=3600.0)
    assert not memory.give_back_if_due()
