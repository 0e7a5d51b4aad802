"""Which lane, and where on Earth, vehicles were, by the lane maps that were stored over time."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lane_order import lane_ids_at, lane_numbers
from geoorbit_ros.core.tables import Frames
from geoorbit_ros.lanes.geojson import LaneFile, parse_lane_file

Array = NDArray[np.float64]


class LanesOverTime:
    """The lane maps of one camera, each valid from its stamp on; the first one also before it.

    Args:
        stamps_ns: When each map was stored, increasing.
        load: GeoJSON text of the map with a stamp.
        place: What errors call the maps.
    """

    def __init__(self, stamps_ns: Sequence[int], load: Callable[[int], str], place: str) -> None:
        self._stamps_ns, self._load, self._place = list(stamps_ns), load, place
        self._valid: tuple[int, LaneFile] | None = None
        self._last_numbers: dict[int, int] | None = None

    def __bool__(self) -> bool:
        return bool(self._stamps_ns)

    def describe(self, frames: Frames) -> dict[str, Array]:
        """Positions and lanes of the rows of some frames, about a second of them.

        Returns:
            (N,) `latitude_deg`, `longitude_deg`, `lane_id`, `lane_number`; NaN where not known.
            The map is the one that was valid when the first frame was taken. A lane that is in the
            last map has its number there all the time: numbers grow while lanes are being found.

        Raises:
            InputFileError: A stored map is damaged.
        """
        rows = frames.rows
        lane_file = self._map_at(int(frames.stamp_ns[0]))
        if lane_file is None:
            nothing = np.full(len(rows), np.nan)
            return dict.fromkeys(
                ("latitude_deg", "longitude_deg", "lane_id", "lane_number"), nothing
            )
        position_m = np.column_stack((rows["x"], rows["y"])).astype(np.float64)
        geodetic = lane_file.datum.to_geodetic(position_m)
        lanes = lane_file.lane_map.lanes
        found = lane_ids_at(position_m, rows["heading"].astype(np.float64), lanes)
        if self._last_numbers is None:
            last = parse_lane_file(self._load(self._stamps_ns[-1]), self._place)
            self._last_numbers = lane_numbers(last.lane_map.lanes)
        number = {0: np.nan, **lane_numbers(lanes), **self._last_numbers}
        return {
            "latitude_deg": geodetic[:, 0],
            "longitude_deg": geodetic[:, 1],
            "lane_id": np.where(found > 0, found, np.nan),
            "lane_number": np.array([number[lane_id] for lane_id in found.tolist()], dtype=float),
        }

    def _map_at(self, stamp_ns: int) -> LaneFile | None:
        if not self._stamps_ns:
            return None
        valid_ns = self._stamps_ns[max(bisect_right(self._stamps_ns, stamp_ns) - 1, 0)]
        if self._valid is None or self._valid[0] != valid_ns:
            self._valid = valid_ns, parse_lane_file(self._load(valid_ns), self._place)
        return self._valid[1]
