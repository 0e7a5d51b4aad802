"""The network as the running simulation gets it: the same lanes, fewer points.

`moveToXY` walks along the whole shape of every lane near the vehicle, several times. A motorway of
400 m drawn every 2 m costs 260 µs per vehicle and step, with points to the centimetre 9 µs
(docs/adr/0017-running-network.md).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.twin.network_file import parse_xml

TOLERANCE_M = 0.01
"""No lane moves by more; netconvert writes coordinates to the same precision."""


def write_running_network(path: Path, out: Path, tolerance_m: float = TOLERANCE_M) -> None:
    """Write a copy of a network with as few shape points as `tolerance_m` allows.

    Ids, lengths and connections stay. Raises RoadNetworkError for a file that can't be read.
    """
    tree = parse_xml(path)
    for element in tree.getroot().iter():
        shape = element.get("shape")
        if shape and element.tag in ("lane", "edge"):
            element.set("shape", _thinned(shape, tolerance_m))
    tree.write(out, encoding="utf-8", xml_declaration=True)


def _thinned(shape: str, tolerance_m: float) -> str:
    words = shape.split()
    if len(words) < 3:
        return shape
    points = np.array([[float(v) for v in word.split(",")[:2]] for word in words])
    return " ".join(words[k] for k in thin(points, tolerance_m))


def thin(line: NDArray[np.float64], tolerance_m: float) -> list[int]:
    """Points of a line (K, 2) to keep, first and last included (Douglas and Peucker 1973)."""
    kept, waiting = [0, len(line) - 1], [(0, len(line) - 1)]
    while waiting:
        a, b = waiting.pop()
        if b <= a + 1:
            continue
        chord, rest = line[b] - line[a], line[a + 1 : b] - line[a]
        length = float(np.hypot(*chord))
        if length > 0.0:
            away = np.abs(chord[0] * rest[:, 1] - chord[1] * rest[:, 0]) / length
            # Beyond the chord's ends the distance is that to the end.
            along = rest @ chord / length
            beyond = np.maximum(np.maximum(-along, along - length), 0.0)
            away = np.hypot(away, beyond)
        else:
            away = np.hypot(rest[:, 0], rest[:, 1])
        farthest = int(np.argmax(away))
        if away[farthest] > tolerance_m:
            k = a + 1 + farthest
            kept.append(k)
            waiting += [(a, k), (k, b)]
    return sorted(kept)
