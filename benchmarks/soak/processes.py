"""Memory and processor time of a fleet's processes, their children included."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

PAGE_MB = os.sysconf("SC_PAGE_SIZE") / 2**20
TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")
BLOCKS = 10


@dataclass(frozen=True)
class Slope:
    """A least-squares line.

    Attributes:
        per_minute: Its slope.
        error: 1-sigma error of the slope.
    """

    per_minute: float
    error: float

    @property
    def in_noise(self) -> float:
        """The slope upwards as a share of twice its error: below 1 it is within the noise."""
        return max(self.per_minute, 0.0) / max(2.0 * self.error, 1e-9)


def usage(up_log: Path) -> dict[str, tuple[float, float]]:
    """(resident MB, processor seconds so far) by process of a fleet, from what `up` has said."""
    started = dict(re.findall(r"(\w+)  started, process (\d+)", up_log.read_text()))
    return {name: family_usage(int(pid)) for name, pid in started.items()}


def family_usage(pid: int) -> tuple[float, float]:
    """The same of one process and its children; those that ended count with their parents."""
    memory_mb = cpu_s = 0.0
    for member in family(pid):
        try:
            words = Path(f"/proc/{member}/stat").read_text().rpartition(")")[2].split()
            memory_mb += PAGE_MB * int(Path(f"/proc/{member}/statm").read_text().split()[1])
        except (FileNotFoundError, ProcessLookupError):  # it has just ended
            continue
        cpu_s += TICK_S * sum(map(int, words[11:15]))
    return memory_mb, cpu_s


def family(pid: int) -> Iterator[int]:
    """A process, its children, theirs."""
    yield pid
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except (FileNotFoundError, ProcessLookupError):
        return
    for child in children:
        yield from family(int(child))


def slope(minute: NDArray[np.float64], value: NDArray[np.float64]) -> Slope:
    """Slope of samples through the means of ten blocks, which are nearly independent.

    Neighbouring samples of memory are not: their own scatter would make the error far too small.
    """
    blocks = np.array_split(np.arange(len(minute)), min(BLOCKS, len(minute)))
    x = np.array([minute[block].mean() for block in blocks])
    y = np.array([value[block].mean() for block in blocks])
    (gain, _), covariance = np.polyfit(x, y, 1, cov=True)
    return Slope(float(gain), float(np.sqrt(covariance[0, 0])))
