"""Lines with as few points as a tolerance allows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def thin(line: NDArray[np.float64], tolerance_m: float) -> list[int]:
    """Points of a line (K, 2) to keep, first and last included (Douglas and Peucker 1973).

    No point of the line is farther from the thinned one than `tolerance_m`.
    """
    kept, waiting = {0, len(line) - 1}, [(0, len(line) - 1)]
    while waiting:
        a, b = waiting.pop()
        if b <= a + 1:
            continue
        chord, rest = line[b] - line[a], line[a + 1 : b] - line[a]
        length = max(float(np.hypot(*chord)), 1e-12)
        across = (chord[0] * rest[:, 1] - chord[1] * rest[:, 0]) / length
        along = rest @ chord / length
        # Beyond the chord's ends the distance is that to the end.
        away = np.hypot(across, np.maximum(np.maximum(-along, along - length), 0.0))
        farthest = int(np.argmax(away))
        if away[farthest] > tolerance_m:
            k = a + 1 + farthest
            kept.add(k)
            waiting += [(a, k), (k, b)]
    return sorted(kept)
