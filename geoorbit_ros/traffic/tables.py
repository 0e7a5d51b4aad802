"""The tables as people get them: `vehicles`, `intervals` and `movements`, as CSV and Parquet.

Columns are a stable interface (docs/formats.md). What is not known is empty.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
from numpy.typing import NDArray

from geoorbit_ros.traffic.class_schemes import ClassScheme
from geoorbit_ros.traffic.event_records import EventKind, EventState
from geoorbit_ros.traffic.interval_clock import IntervalClock
from geoorbit_ros.traffic.measures import ALL, MEASURE_DTYPE
from geoorbit_ros.traffic.records import NO_LANE

DECIMALS = {
    "speed_kmh": 2,
    "speed_sigma_kmh": 2,
    "length_m": 1,
    "observed": 4,
    "lane_share": 4,
    "heavy_share": 4,
    "platoon_share": 4,
}
"""Digits after the point, where not two or three. More than the errors allow would be untrue."""


EVENT_NAMES = {
    EventKind.STOPPED: "stopped_vehicle",
    EventKind.WRONG_WAY: "wrong_way",
    EventKind.QUEUE: "queue",
    EventKind.LANE_UNUSED: "lane_unused",
    EventKind.SPEED_DROP: "speed_drop",
}
"""Kinds of events in the column `kind`."""


def vehicle_table(passages: NDArray[np.void], scheme: ClassScheme) -> pa.Table:
    """One row per vehicle and lane that it drove along, in the order in which they were last seen.

    Times are in seconds on the clock of the tracks.
    """
    category = scheme.category_of(passages["class_id"], passages["length_m"])
    return pa.table(
        {
            "track_id": passages["track_id"],
            "lane_id": passages["lane_id"],
            "class": _names(category, scheme),
            "time_first_s": _seconds(passages["first_ns"]),
            "time_last_s": _seconds(passages["last_ns"]),
            "speed_kmh": _rounded(3.6 * passages["speed_mps"], 2),
            "speed_sigma_kmh": _rounded(3.6 * passages["speed_sigma_mps"], 2),
            "length_m": _rounded(passages["length_m"], 1),
            "from_lane": _lanes(passages["from_lane"]),
            "to_lane": _lanes(passages["to_lane"]),
            "vehicle_id": passages["vehicle_id"],
        }
    )


def interval_table(
    measures: NDArray[np.void], scheme: ClassScheme, clock: IntervalClock
) -> pa.Table:
    """One row per interval, lane and class; `lane_id` is empty for all lanes of a station."""
    columns: dict[str, object] = {
        "interval_start": _moments(measures["start_ns"], clock),
        "interval_end": _moments(measures["end_ns"], clock),
    }
    for name in MEASURE_DTYPE.names or ():
        if name in ("start_ns", "end_ns"):
            continue
        if name == "category":
            columns["class"] = _names(measures["category"], scheme)
        elif name in ("lane_id", "lane_number"):
            columns[name] = _lanes(measures[name])
        elif name == "volume":
            missing = (measures["volume"] == 0) & np.isnan(measures["flow_veh_per_h"])
            columns[name] = pa.array(measures["volume"], mask=missing)
        elif MEASURE_DTYPE[name].kind == "f":
            columns[name] = _rounded(measures[name], DECIMALS.get(name, 2))
        else:
            columns[name] = measures[name]
    return pa.table(columns)


def movement_table(
    movements: NDArray[np.void], scheme: ClassScheme, clock: IntervalClock
) -> pa.Table:
    """One row per interval, pair of lanes and class."""
    return pa.table(
        {
            "interval_start": _moments(movements["start_ns"], clock),
            "interval_end": _moments(movements["end_ns"], clock),
            "entry": movements["entry"],
            "exit": movements["exit"],
            "from_lane": movements["from_lane"],
            "to_lane": movements["to_lane"],
            "class": _names(movements["category"], scheme),
            "volume": movements["volume"],
        }
    )


def event_table(events: NDArray[np.void]) -> pa.Table:
    """One row per event, as it was last told; see `event_records.EVENT_DTYPE`.

    Times are in seconds on the clock of the tracks, places in metres of the map frame.
    """
    ended = events["state"] == EventState.ENDED
    return pa.table(
        {
            "event_id": events["event_id"],
            "kind": pa.array([EVENT_NAMES[EventKind(k)] for k in events["kind"]], pa.string()),
            "time_first_s": _seconds(events["first_ns"]),
            "time_last_s": _seconds(events["last_ns"]),
            "ended": ended,
            "lane_id": _lanes(events["lane_id"]),
            "track_id": events["track_id"],
            "along_m": _rounded(events["arc_m"], 1),
            "x_m": _rounded(events["x"], 2),
            "y_m": _rounded(events["y"], 2),
            "vehicles": events["vehicles"],
            "queue_m": _rounded(
                np.where(events["kind"] == EventKind.QUEUE, events["length_m"], np.nan), 1
            ),
            "speed_kmh": _rounded(3.6 * events["speed_mps"], 1),
            "usual_speed_kmh": _rounded(3.6 * events["usual_mps"], 1),
            "by_chance_s": _rounded(events["by_chance_s"], 0),
        }
    )


def write_csv(path: Path, tables: Sequence[pa.Table]) -> None:
    """Write tables of the same columns below one another."""
    options = pacsv.WriteOptions(quoting_header="none", quoting_style="needed")
    with pacsv.CSVWriter(path, tables[0].schema, write_options=options) as writer:
        for table in tables:
            writer.write_table(table)


def write_parquet(path: Path, tables: Sequence[pa.Table]) -> None:
    """Write tables of the same columns below one another."""
    with pq.ParquetWriter(path, tables[0].schema, compression="zstd") as writer:
        for table in tables:
            writer.write_table(table)


def _names(category: NDArray[np.int64], scheme: ClassScheme) -> list[str]:
    names = np.array([*scheme.categories, ALL], dtype=object)
    return [str(name) for name in names[category]]


def _lanes(lane_id: NDArray[np.int64]) -> pa.Array:
    return pa.array(lane_id, mask=lane_id == NO_LANE)


def _seconds(stamp_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Seconds with milliseconds: exact to a microsecond for times since 1970."""
    return np.asarray(np.round(stamp_ns / 1_000_000) / 1000.0)


def _rounded(value: NDArray[np.float64], digits: int) -> pa.Array:
    return pa.array(np.round(value, digits), from_pandas=True)


def _moments(stamp_ns: NDArray[np.int64], clock: IntervalClock) -> list[str]:
    """Texts; each stamp is written once, however many rows it has."""
    stamps, where = np.unique(stamp_ns, return_inverse=True)
    texts = [clock.text(int(stamp)) for stamp in stamps]
    return [texts[k] for k in where.tolist()]
