"""The protocol that every lane estimator satisfies."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core import plugins
from geoorbit_ros.core.lanes import LaneMap
from geoorbit_ros.lanes.mapping.state import State
from geoorbit_ros.lanes.parameters import LaneParameters


@runtime_checkable
class LaneEstimator(Protocol):
    """Turns ground tracks into lanes, once or continuously.

    Results depend on the rows and their stamps only, never on wall time or on how the rows were
    cut into calls.
    """

    def add(self, stamp_ns: int, rows: NDArray[np.void]) -> None:
        """Take one frame of `TRACK_DTYPE` rows; stamps increase from call to call."""
        ...

    def lanes(self, parameters: LaneParameters) -> LaneMap:
        """The lanes as the evidence stands now. Lanes keep their ids from call to call."""
        ...

    def update(self, parameters: LaneParameters) -> LaneMap:
        """The lanes refined by what came since the last map, at a fraction of its cost."""
        ...

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
    return plugins.make("estimator", name, LaneEstimator)  # type: ignore[type-abstract]
