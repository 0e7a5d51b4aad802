"""Boxes in, lane map out, without a ROS graph: what `geoorbit lanes`, report and benchmarks run.

The node graph calls the same projector and mapper in the same order, frame by frame.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import NoTrafficError
from geoorbit_ros.core.lanes import LaneMap
from geoorbit_ros.core.tables import VEHICLE_CLASS_TEXT, VEHICLE_CLASSES, Frames
from geoorbit_ros.lanes.mapping.mapper import LaneMapper


class GroundProjector(Protocol):
    """Turns one camera's tracked boxes into ground tracks, frame by frame, in time order."""

    def project(self, stamp_ns: int, rows: NDArray[np.void]) -> NDArray[np.void]:
        """Project one frame.

        Args:
            stamp_ns: Capture time of the frame, later than that of the previous call.
            rows: (N,) `PIXEL_TRACK_DTYPE`.

        Returns:
            (M,) `TRACK_DTYPE`, M <= N: rows above the horizon are left out.
        """
        ...


StampedRows = tuple[int, NDArray[np.void]]
"""Capture time in nanoseconds and the rows of one frame."""


def project_frames(frames: Frames, projector: GroundProjector) -> Iterator[StampedRows]:
    """Ground tracks of each frame, in time order.

    Args:
        frames: Frames of `PIXEL_TRACK_DTYPE`.
        projector: A projector that has seen no frame yet.

    Yields:
        Stamp and (M,) `TRACK_DTYPE`, frames without vehicles included.
    """
    for k, stamp_ns in enumerate(frames.stamp_ns):
        yield int(stamp_ns), projector.project(int(stamp_ns), frames.frame(k))


def map_lanes(tracks: Iterable[StampedRows], mapper: LaneMapper, place: str = "tracks") -> LaneMap:
    """Feed all tracks to the mapper and take its last map.

    Args:
        tracks: Frames of `TRACK_DTYPE` rows in time order.
        mapper: A mapper that has seen no frame yet.
        place: Where the tracks came from, for the error.

    Raises:
        NoTrafficError: No lane, not even a tentative one, can be seen in the tracks.
    """
    frame_count, ids, classes = 0, set[int](), set[int]()
    for stamp_ns, rows in tracks:
        mapper.add(stamp_ns, rows)
        frame_count += 1
        ids.update(rows["track_id"].tolist())
        classes.update(rows["class_id"].tolist())
    if not ids:
        found = f"{frame_count} frames without a vehicle on the road"
        raise NoTrafficError(place, found, "vehicles driving by")
    lane_map = mapper.finish()
    if not lane_map.lanes:
        found = f"{len(ids)} tracks in {frame_count} frames, none driving along a lane"
        if classes.isdisjoint(VEHICLE_CLASSES):
            found = f"{len(ids)} tracks of class {', '.join(map(str, sorted(classes)))} only"
            raise NoTrafficError(place, found, f"vehicles: {VEHICLE_CLASS_TEXT}")
        raise NoTrafficError(place, found, "vehicles driving by")
    return lane_map
