"""What is told of an event on the road: when it began, where it is, what shows it."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray


class EventKind(IntEnum):
    """What happened."""

    STOPPED = 1
    WRONG_WAY = 2
    QUEUE = 3
    LANE_UNUSED = 4
    SPEED_DROP = 5


class EventState(IntEnum):
    """What a row says of its event."""

    BEGAN = 1
    CHANGED = 2
    ENDED = 3


EVENT_DTYPE = np.dtype(
    [
        ("event_id", "<i8"),
        ("kind", "<i4"),
        ("state", "<i4"),
        ("stamp_ns", "<i8"),
        ("first_ns", "<i8"),
        ("last_ns", "<i8"),
        ("lane_id", "<i8"),
        ("track_id", "<i8"),
        ("arc_m", "<f8"),
        ("x", "<f8"),
        ("y", "<f8"),
        ("vehicles", "<i4"),
        ("length_m", "<f8"),
        ("speed_mps", "<f8"),
        ("usual_mps", "<f8"),
        ("by_chance_s", "<f8"),
    ]
)
"""One row each time that an event begins, changes or ends; rows of one event share `event_id`.

`stamp_ns` is when that could be said, `first_ns` when it began, `last_ns` when it was last seen (of
an `ENDED` row: its end). `arc_m` is the place along the lane's centreline, `x` and `y` the same
place in the map frame in metres. `track_id` is the track that shows it. NaN where a number says
nothing of this kind:

- `STOPPED`: `vehicles` passed beside it; `length_m` is how far it was seen to drive before.
- `WRONG_WAY`: `speed_mps`, `length_m` driven against the lane.
- `QUEUE`: `vehicles` in it, `length_m` from the tail to the head; the place is the tail, and
  `track_id` the last vehicle.
- `LANE_UNUSED`: `vehicles` on the lanes beside since the last one in it, which is `track_id` at
  `first_ns`; `by_chance_s` is how often, by their flow, chance alone would leave the lane so empty:
  once in so many seconds.
- `SPEED_DROP`: `speed_mps` now and `usual_mps` before, medians of the lane; `vehicles` now."""


@dataclass(slots=True)
class EventLog:
    """Rows of `EVENT_DTYPE`, in the order in which they could be said.

    Attributes:
        events: How many events have begun so far.
        rows: How many rows there were so far.
    """

    events: int = 0
    rows: int = 0
    _rows: list[NDArray[np.void]] = field(default_factory=list)
    _lasting: dict[int, NDArray[np.void]] = field(default_factory=dict)

    def begin(self, kind: EventKind, stamp_ns: int, **what: float) -> NDArray[np.void]:
        """A new event; returns its row, (1,), for `change` and `end`.

        Args:
            kind: What happened.
            stamp_ns: Time of the data that shows it.
            what: Other fields of `EVENT_DTYPE`.
        """
        self.events += 1
        row = np.zeros(1, EVENT_DTYPE)
        for name in ("length_m", "speed_mps", "usual_mps", "by_chance_s"):
            row[name] = np.nan
        row["event_id"], row["kind"] = self.events, kind
        self._write(row, EventState.BEGAN, stamp_ns, what)
        return row

    def change(self, row: NDArray[np.void], stamp_ns: int, **what: float) -> None:
        """Something about an event is new."""
        self._write(row, EventState.CHANGED, stamp_ns, what)

    def end(self, row: NDArray[np.void], stamp_ns: int, **what: float) -> None:
        """An event is over."""
        self._write(row, EventState.ENDED, stamp_ns, what)

    def take(self) -> NDArray[np.void]:
        """Rows since the last call."""
        rows = np.concatenate([np.empty(0, EVENT_DTYPE), *self._rows])
        self._rows.clear()
        return rows

    @property
    def lasting(self) -> NDArray[np.void]:
        """(E,) the newest row of each event that has not ended, by number."""
        return np.concatenate([np.empty(0, EVENT_DTYPE), *self._lasting.values()])

    def go_on(self, rows: NDArray[np.void], count: int, stamp_ns: int) -> None:
        """Go on with the numbers of an earlier log whose watch is lost.

        What had not ended by then is told to have ended: nobody knows whether it goes on.

        Args:
            rows: `EVENT_DTYPE` that it told; the newest row of each event is enough.
            count: How many rows it told.
            stamp_ns: The last time that it knew of.
        """
        self.rows, self.events = count, int(rows["event_id"].max(initial=0))
        for row in newest_rows(rows):
            if row["state"] != EventState.ENDED:
                self.end(np.array([row], EVENT_DTYPE), stamp_ns)

    def _write(
        self, row: NDArray[np.void], state: EventState, stamp_ns: int, what: dict[str, float]
    ) -> None:
        row["state"], row["stamp_ns"] = state, stamp_ns
        for name, value in what.items():
            row[name] = value
        self._rows.append(row.copy())
        self.rows += 1
        if state is EventState.ENDED:
            self._lasting.pop(int(row["event_id"][0]), None)
        else:
            self._lasting[int(row["event_id"][0])] = self._rows[-1]


def count_begun(rows: NDArray[np.void]) -> int:
    """How many events begin in rows of `EVENT_DTYPE`."""
    return int(np.count_nonzero(rows["state"] == EventState.BEGAN))


def newest_rows(rows: NDArray[np.void]) -> NDArray[np.void]:
    """The newest row of each event, by their beginning.

    Args:
        rows: `EVENT_DTYPE`, in the order in which they were told.
    """
    newest = {int(event): k for k, event in enumerate(rows["event_id"].tolist())}
    rows = rows[sorted(newest.values())]
    return np.asarray(rows[np.argsort(rows["first_ns"], kind="stable")])
