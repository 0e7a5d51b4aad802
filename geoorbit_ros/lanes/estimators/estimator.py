"""The protocol that every lane estimator satisfies, and two that it may satisfy."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core import plugins
from geoorbit_ros.core.lanes import LaneMap
from geoorbit_ros.lanes.estimators.curvilinear.trajectory_segments import TrajectorySegments
from geoorbit_ros.lanes.estimators.result_check import ResultCheck
from geoorbit_ros.lanes.parameters import LaneParameters

State = dict[str, NDArray[Any]]
"""Arrays by name, none of objects: what is saved for a process that is started again."""


@runtime_checkable
class LaneEstimator(Protocol):
    """Derives lanes from ground tracks.

    Results depend on the rows and their stamps only, never on wall time or on how the rows were
    cut into calls. Lasting ids, confirmed lanes that stay confirmed, which lanes are shown, and
    when to ask again are the mapper's work: `lanes/mapping/mapper.py`.
    """

    def add(self, stamp_ns: int, rows: NDArray[np.void]) -> None:
        """Take one frame of `TRACK_DTYPE` rows; stamps increase from call to call."""
        ...

    def lanes(self, parameters: LaneParameters) -> LaneMap:
        """All lanes that the rows so far may show, weak ones too; their `lane_id` is ignored.

        Asking twice without new rows gives the same map.
        """
        ...


@runtime_checkable
class SegmentSource(Protocol):
    """An estimator whose trajectory segments the mapper can count between two derivations.

    The maps of such an estimator say in `segments` how many they were derived from. Estimators
    without these methods are asked for their lanes at every update.
    """

    def finished_segments(self) -> int:
        """How many trajectory segments have ended so far, forgotten ones included."""
        ...

    def segments_after(self, count: int, stamp_ns: int) -> TrajectorySegments:
        """Segments that ended after the first `count` and began after `stamp_ns`."""
        ...


@runtime_checkable
class Restorable(Protocol):
    """An estimator that goes on where it was when its process is started again.

    Of other estimators only the lanes and their ids are remembered.
    """

    def state(self) -> State:
        """What it remembers, as arrays."""
        ...

    def restore(self, state: Mapping[str, NDArray[Any]], stamp_ns: int) -> None:
        """Go on from a state; the next frame comes at `stamp_ns`.

        Raises:
            KeyError, ValueError, IndexError: Not a state of this estimator.
        """
        ...


def make_estimator(name: str) -> LaneEstimator:
    """A fresh estimator, by its registered name or as `FILE.py:CLASS`.

    Raises:
        ParameterError: No estimator has this name, or the file has no such class.
    """
    return plugins.make(
        "estimator",
        name,
        LaneEstimator,  # type: ignore[type-abstract]
        returns=ResultCheck().returns(),
        optional=(SegmentSource, Restorable),
    )
