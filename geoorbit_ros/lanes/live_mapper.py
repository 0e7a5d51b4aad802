"""A lane mapper for cameras that run for ever: it starts anew, and goes on after a crash."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.lanes import LaneMap
from geoorbit_ros.lanes.factory import make_estimator
from geoorbit_ros.lanes.mapper import LaneMapper
from geoorbit_ros.lanes.memory import LaneMemory
from geoorbit_ros.lanes.parameters import LaneParameters


class LiveMapper:
    """A `LaneMapper` with a memory.

    Args:
        estimator: Name of the method.
        parameters: Theta.
        update_period_s: Data time between two maps.
        state_file: Where lanes and traffic are remembered; None forgets them.
        warn: Takes a sentence when they can't be.
    """

    def __init__(
        self,
        estimator: str,
        parameters: LaneParameters,
        update_period_s: float,
        state_file: Path | None,
        warn: Callable[[str], None],
    ) -> None:
        self._estimator, self._period_s, self._warn = estimator, update_period_s, warn
        self._memory = LaneMemory(state_file, estimator) if state_file else None
        self._resumed = self._memory is None
        self._mapper = self._fresh(parameters)

    @property
    def parameters(self) -> LaneParameters:
        """Theta."""
        return self._mapper.parameters

    @parameters.setter
    def parameters(self, parameters: LaneParameters) -> None:
        self._mapper.parameters = parameters

    def restart(self) -> None:
        """Forget all traffic: what comes next is another recording."""
        self._mapper = self._fresh(self.parameters)

    def add(self, stamp_ns: int, rows: NDArray[np.void], datum: Datum | None) -> LaneMap | None:
        """Take one frame; a map when one is due, or when an earlier one was found again.

        Args:
            stamp_ns: Capture time.
            rows: (N,) `TRACK_DTYPE`.
            datum: Origin of the map frame; nothing is remembered while it is not known.
        """
        found = None
        if self._memory and datum and not self._resumed:
            self._resumed = True
            found = self._resume(self._memory, datum, stamp_ns)
        lane_map = self._mapper.add(stamp_ns, rows)
        if lane_map and self._memory and datum:
            try:
                self._memory.save_if_due(self._mapper.estimator, datum, stamp_ns)
            except InputFileError as error:
                self._warn(f"lanes are not remembered: {error}")
        return lane_map or found

    def finish(self) -> LaneMap:
        """The map of all frames so far, now."""
        return self._mapper.finish()

    def _fresh(self, parameters: LaneParameters) -> LaneMapper:
        return LaneMapper(make_estimator(self._estimator), parameters, self._period_s)

    def _resume(self, memory: LaneMemory, datum: Datum, stamp_ns: int) -> LaneMap | None:
        mapper = self._fresh(self.parameters)
        try:
            if not memory.resume(mapper.estimator, datum, stamp_ns):
                return None
        except InputFileError as error:
            self._warn(f"lanes start anew: {error}")
            return None
        self._mapper = mapper
        return mapper.finish()
