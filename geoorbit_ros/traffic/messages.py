"""Traffic as it goes out on topics: tables that PointCloud2 can hold, and JSON for people."""

from __future__ import annotations

import json
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.traffic.class_schemes import ClassScheme
from geoorbit_ros.traffic.event_records import EVENT_DTYPE
from geoorbit_ros.traffic.interval_clock import NS, IntervalClock
from geoorbit_ros.traffic.live import Finished
from geoorbit_ros.traffic.measures import MEASURE_DTYPE
from geoorbit_ros.traffic.tables import event_table, interval_table

MICRO_NS = 1_000
"""Times in seconds are exact to this: a float64 has no more digits for the years after 1970."""


def point_table(rows: NDArray[np.void]) -> NDArray[np.void]:
    """Rows for a PointCloud2, which has no 64-bit whole numbers.

    Columns in nanoseconds become float64 seconds (`stamp_ns`: `stamp_s`), other whole numbers
    int32; all others stay.
    """
    out = np.zeros(len(rows), point_type(rows.dtype))
    for name in rows.dtype.names or ():
        if name.endswith("_ns"):
            out[f"{name[:-3]}_s"] = rows[name] // MICRO_NS / (NS / MICRO_NS)
        else:
            out[name] = rows[name]
    return out


@lru_cache(maxsize=8)
def point_type(dtype: np.dtype[np.void]) -> np.dtype[np.void]:
    """Type of `point_table` of rows of a type."""
    columns = list[tuple[str, str]]()
    for name in dtype.names or ():
        if name.endswith("_ns"):
            columns.append((f"{name[:-3]}_s", "<f8"))
        else:
            columns.append((name, "<i4" if dtype[name].str == "<i8" else dtype[name].str))
    return np.dtype(columns)


def intervals_json(
    finished: Finished, scheme: ClassScheme, clock: IntervalClock, camera_id: str
) -> str:
    """The last of some intervals as a text for people; what is not known is left out."""
    start_ns = int(finished.edges_ns[-2])
    rows = finished.measures[finished.measures["start_ns"] == start_ns]
    table = interval_table(rows, scheme, clock)
    shared = ("interval_start", "interval_end", "observed")
    content: dict[str, Any] = {"camera_id": camera_id}
    content |= {name: table[name][0].as_py() for name in shared if len(rows)}
    content["map_stamp_s"] = finished.lanes.map_ns / NS
    content["rows"] = [
        {key: value for key, value in row.items() if value is not None and key not in shared}
        for row in table.to_pylist()
    ]
    return json.dumps(content)


def events_json(lasting: NDArray[np.void], clock: IntervalClock, camera_id: str) -> str:
    """Events that last now as a text for people; what is not known is left out.

    Args:
        lasting: `event_records.EVENT_DTYPE`, the newest row of each.
        clock: Whose local time.
        camera_id: The camera's name.
    """
    rows = list[dict[str, Any]]()
    for event, row in zip(event_table(lasting).to_pylist(), lasting, strict=True):
        since = {"since": clock.text(int(row["first_ns"]))}
        left_out = ("ended", "time_first_s", "time_last_s")
        known = {k: v for k, v in event.items() if v is not None and k not in left_out}
        rows.append(known | since)
    return json.dumps({"camera_id": camera_id, "events": rows})


EVENT_POINT_DTYPE = point_type(EVENT_DTYPE)
"""Rows of the topic `traffic/events`."""
INTERVAL_POINT_DTYPE = point_type(MEASURE_DTYPE)
"""Rows of the topic `traffic/intervals`."""
