"""Continuous mapping: feeds an estimator and renews the map on a schedule of data time alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.core.lanes import LaneMap
from geoorbit_ros.lanes.estimators.estimator import LaneEstimator
from geoorbit_ros.lanes.parameters import LaneParameters

DEFAULT_UPDATE_PERIOD_S = 5.0


class LaneMapper:
    """The lane map of one camera, renewed every `update_period_s` of data time.

    The schedule follows the stamps, so a bag gives the same maps, ids included, at any replay rate
    and without a graph.

    Attributes:
        estimator: What it feeds.
        parameters: Theta; may be replaced between frames.

    Raises:
        ParameterError: A period that is not positive.
    """

    def __init__(
        self,
        estimator: LaneEstimator,
        parameters: LaneParameters | None = None,
        update_period_s: float = DEFAULT_UPDATE_PERIOD_S,
    ) -> None:
        if not update_period_s > 0.0:
            raise ParameterError("parameter 'update_period_s'", update_period_s, "more than 0 s")
        self.estimator = estimator
        self.parameters = parameters or LaneParameters()
        self._period_ns = round(update_period_s * 1e9)
        self._due_ns: int | None = None

    def add(self, stamp_ns: int, rows: NDArray[np.void]) -> LaneMap | None:
        """Take one frame; the renewed map when a period has passed, else None.

        Args:
            stamp_ns: Capture time, later than that of the call before.
            rows: (N,) `TRACK_DTYPE`.
        """
        self.estimator.add(stamp_ns, rows)
        if self._due_ns is None:
            self._due_ns = stamp_ns + self._period_ns
        if stamp_ns < self._due_ns:
            return None
        periods = (stamp_ns - self._due_ns) // self._period_ns + 1
        self._due_ns += periods * self._period_ns
        return self.estimator.update(self.parameters)

    def finish(self) -> LaneMap:
        """The map of all frames so far, now."""
        return self.estimator.lanes(self.parameters)
