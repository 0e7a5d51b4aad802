"""One camera's tracks, interpolated from its frames to the times of the simulation's steps."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.errors import RoadNetworkError
from geoorbit_ros.core.tables import FLAG_PREDICTED
from geoorbit_ros.mapcheck.alignment import Alignment
from geoorbit_ros.roadnet.plane import ConformalMap

OBSERVATION_DTYPE = np.dtype(
    [
        ("stamp_ns", "<i8"),
        ("track_id", "<i8"),
        ("xy", "<f8", 2),
        ("velocity", "<f8", 2),
        ("heading", "<f8"),
        ("length", "<f8"),
        ("width", "<f8"),
        ("sigma", "<f8"),
        ("class_id", "<i4"),
        ("predicted", "?"),
    ]
)
"""A track at one time, in the twin's map frame; `heading` is NaN while it is not known."""

MAX_LAG_S = 0.5
"""A camera that is behind the others by more is not extrapolated. Chosen: larger moves vehicles on
guesses for longer, smaller lets vehicles of a slow camera coast instead."""
MAX_AWAY_M = 1e5
"""A camera farther from the network's datum is refused, and positions farther from its own are
dropped. Chosen: networks are some tens of kilometres wide."""
MAX_SPEED_MPS, MAX_SIGMA_M = 100.0, 10.0
"""Velocities above count as 0, errors above as this. Chosen: no road vehicle drives 360 km/h; an
error of three lanes says nothing about the lane, however much larger it is."""
_FIT_RANGE_M = 2000.0
"""Around a camera, its frame is converted to the twin's by a polynomial fitted this far. Chosen:
farther than a roadside camera sees."""


class CameraTracks:
    """Frames of one camera that are still needed.

    Args:
        name: The camera.
        hold_s: How long a track may be missing from frames without ending.
        datum: Origin of the twin's map frame.

    Attributes:
        name: The camera.
        alignment: Lays the tracks on the network, where camera and map disagree as a whole.
        newest_ns: Time of the newest frame.
    """

    def __init__(self, name: str, hold_s: float, datum: Datum) -> None:
        self.name = name
        self._hold_ns = round(hold_s * 1e9)
        self._datum = datum
        self._plane: ConformalMap | None = None
        self.alignment: Alignment | None = None
        self.reset()

    def reset(self) -> None:
        """Forget all frames, because the source starts again."""
        self._frames: deque[tuple[int, NDArray[np.void]]] = deque()
        self._last = np.empty(0, OBSERVATION_DTYPE)
        self._last_ns: int | None = None
        self.newest_ns: int | None = None

    def set_datum(self, datum: Datum) -> None:
        """Set the origin of the camera's own map frame; without it, the twin's frame is used.

        Raises:
            RoadNetworkError: It is not near the network.
        """
        away_m = float(np.hypot(*self._datum.to_local(datum.latitude_deg, datum.longitude_deg)[0]))
        if not away_m <= MAX_AWAY_M:
            far = f"{away_m / 1e3:.0f} km" if np.isfinite(away_m) else "thousands of kilometres"
            found = f"a datum {far} from the network"
            raise RoadNetworkError(f"camera '{self.name}'", found, "a camera that sees its roads")
        if datum == self._datum:
            self._plane = None
            return
        side = np.linspace(-_FIT_RANGE_M, _FIT_RANGE_M, 9)
        grid = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
        self._plane = ConformalMap(grid, self._datum.to_local(*datum.to_geodetic(grid).T))

    def add(self, stamp_ns: int, rows: NDArray[np.void]) -> None:
        """Take a frame of `TRACK_DTYPE` rows, later than the one before.

        Rows with impossible positions are dropped. Impossible velocities count as 0, unknown errors
        as `MAX_SIGMA_M`, impossible headings as not known.
        """
        table = np.empty(len(rows), OBSERVATION_DTYPE)
        table["stamp_ns"] = stamp_ns
        for k, (place, speed) in enumerate((("x", "vx"), ("y", "vy"))):
            table["xy"][:, k], table["velocity"][:, k] = rows[place], rows[speed]
        for name in ("track_id", "heading", "length", "width", "sigma", "class_id"):
            table[name] = rows[name]
        table["predicted"] = (rows["flags"] & FLAG_PREDICTED) != 0
        with np.errstate(invalid="ignore"):  # NaN is beyond every limit
            table = table[(np.abs(table["xy"]) <= MAX_AWAY_M).all(axis=1)]
            table["velocity"][~(np.abs(table["velocity"]) <= MAX_SPEED_MPS).all(axis=1)] = 0.0
            table["sigma"][~(table["sigma"] <= MAX_SIGMA_M)] = MAX_SIGMA_M
            table["heading"][~(np.abs(table["heading"]) <= 4.0 * np.pi)] = np.nan
        if self._plane is not None:
            turn = self._plane.turn_rad(table["xy"])
            table["xy"] = self._plane.points(table["xy"])
            table["heading"] += turn
            table["velocity"] = _turned(table["velocity"], turn)
        if self.alignment is not None:
            turn = np.full(len(table), self.alignment.turn_rad)
            table["xy"] = self.alignment.points(table["xy"])
            table["heading"] += turn
            table["velocity"] = _turned(table["velocity"], turn)
        self._frames.append((stamp_ns, table))
        self.newest_ns = stamp_ns

    def at(self, time_ns: int) -> NDArray[np.void]:
        """Tracks at a time that is not earlier than the last one asked for.

        A track exists from its first frame to its last. Between two frames it is interpolated, also
        where frames are missing. Where the camera is behind and no later frame has come, tracks go
        on with their velocity and are marked as predicted.
        """
        while self._frames and self._frames[0][0] <= time_ns:
            self._move_past(*self._frames.popleft())
        last = self._last
        if self._last_ns == time_ns:
            exact: NDArray[np.void] = last[last["stamp_ns"] == time_ns]
            return exact
        if self._frames:
            return _between(last, self._frames[0][1], time_ns)
        fresh: NDArray[np.void] = last[last["stamp_ns"] == (self._last_ns or 0)].copy()
        ahead_s = (time_ns - fresh["stamp_ns"]) * 1e-9
        fresh = fresh[ahead_s <= MAX_LAG_S]
        fresh["xy"] += fresh["velocity"] * (time_ns - fresh["stamp_ns"])[:, None] * 1e-9
        fresh["predicted"] = True
        return fresh

    def _move_past(self, stamp_ns: int, table: NDArray[np.void]) -> None:
        """Keep a frame's tracks as the last ones: its time is over."""
        old = self._last
        kept = ~np.isin(old["track_id"], table["track_id"])
        kept &= old["stamp_ns"] >= stamp_ns - self._hold_ns
        self._last = np.concatenate([old[kept], table])
        self._last_ns = stamp_ns


def _between(before: NDArray[np.void], after: NDArray[np.void], time_ns: int) -> NDArray[np.void]:
    """Tracks that are in both tables, interpolated linearly."""
    _, a, b = np.intersect1d(
        before["track_id"], after["track_id"], assume_unique=False, return_indices=True
    )
    start, end = before[a], after[b]
    share = (time_ns - start["stamp_ns"]) / (end["stamp_ns"] - start["stamp_ns"])
    out = end.copy()
    for name in ("xy", "velocity"):
        out[name] = start[name] + share[:, None] * (end[name] - start[name])
    turn = (end["heading"] - start["heading"] + np.pi) % (2 * np.pi) - np.pi
    # A heading that becomes known holds from then on.
    out["heading"] = np.where(
        np.isnan(start["heading"]), np.nan, start["heading"] + share * np.nan_to_num(turn)
    )
    out["predicted"] = start["predicted"] | end["predicted"]
    return out


def _turned(vectors: NDArray[np.float64], turn_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    cos, sin = np.cos(turn_rad), np.sin(turn_rad)
    x, y = vectors.T
    return np.column_stack((cos * x - sin * y, sin * x + cos * y))
