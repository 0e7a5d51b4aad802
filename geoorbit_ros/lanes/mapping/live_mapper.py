"""A lane mapper for cameras that run for months: it can start anew, and goes on after a crash."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.array_file import read_arrays
from geoorbit_ros.core.errors import InputFileError, PluginError
from geoorbit_ros.core.lanes import LaneMap
from geoorbit_ros.core.state_file import UNREADABLE, StateFile
from geoorbit_ros.lanes.estimators.estimator import make_estimator
from geoorbit_ros.lanes.mapping.mapper import LaneMapper
from geoorbit_ros.lanes.parameters import LaneParameters

FORMAT_VERSION = 2
"""Of saved files; a file of another version is refused. Since 2 the mapper is saved."""
SAVE_PERIOD_S = 10.0
"""Data time between two saves. What a crash loses is so much evidence, never an id. Chosen: longer
loses more, shorter writes more often."""


class LaneMemory:
    """Saves a mapper now and then, and gives its state to a fresh one.

    Args:
        file: Where; made with its folder when first saved. A damaged one is set aside.
        estimator: Name of the method: one method's memory means nothing to another.

    Attributes:
        told: What was set aside, in sentences.
    """

    def __init__(self, file: Path, estimator: str) -> None:
        self._file, self._name = StateFile(file, "a saved lane map"), estimator
        self.told = self._file.told
        self._saved_ns: int | None = None

    def resume(self, mapper: LaneMapper, datum: Datum, stamp_ns: int) -> bool:
        """Give a fresh mapper what was saved, as if until just before `stamp_ns`.

        Args:
            mapper: One that has seen no frame yet.
            datum: Origin of the map frame now.
            stamp_ns: Capture time of the frame that comes next.

        Returns:
            False when there is nothing to resume from.

        Raises:
            InputFileError: A sound file, of another method, format or datum.
        """
        found = self._file.read(_content)
        if found is None:
            return False
        about, state = found
        self._check(about, datum)
        try:
            mapper.restore(state, stamp_ns)
        except UNREADABLE as error:
            reason = f"{type(error).__name__}: {error}"
            raise InputFileError(str(self._file.path), reason, "a saved lane map") from error
        return True

    def save_if_due(self, mapper: LaneMapper, datum: Datum, stamp_ns: int) -> bool:
        """Save when `SAVE_PERIOD_S` of data have passed since the last time.

        Raises:
            InputFileError: The file can't be written.
        """
        if self._saved_ns is not None and 0 <= stamp_ns - self._saved_ns < SAVE_PERIOD_S * 1e9:
            return False
        self._saved_ns = stamp_ns
        self.save(mapper, datum)
        return True

    def save(self, mapper: LaneMapper, datum: Datum) -> None:
        """Replace the file by the state as it is.

        No fsync: a killed process loses nothing of what it wrote, and this runs between frames.

        Raises:
            InputFileError: The file can't be written.
        """
        buffer = io.BytesIO()
        arrays: dict[str, Any] = {"about": np.array(self._about(datum)), **mapper.state()}
        np.savez(buffer, **arrays)
        self._file.write(buffer.getvalue(), sync=False)

    def _about(self, datum: Datum) -> list[str]:
        origin = f"{datum.latitude_deg!r} {datum.longitude_deg!r}"
        return [f"format {FORMAT_VERSION}", self._name, origin]

    def _check(self, about: list[str], datum: Datum) -> None:
        for found, wanted in zip(about, self._about(datum), strict=True):
            if found != wanted:
                place = str(self._file.path)
                raise InputFileError(place, f"saved for '{found}'", f"'{wanted}' as it is now")


def _content(path: Path) -> tuple[list[str], dict[str, NDArray[Any]]]:
    """What the file is about, and the mapper's arrays."""
    state = read_arrays(path, "a saved lane map")
    return state.pop("about").tolist(), state


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

    @property
    def doubtful(self) -> bool:
        """Whether the latest rows say that something speaks against them."""
        return self._mapper.doubtful

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
                self._memory.save_if_due(self._mapper, datum, stamp_ns)
            except (InputFileError, PluginError) as error:
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
            resumed = memory.resume(mapper, datum, stamp_ns)
            for sentence in memory.told:
                self._warn(sentence)
            if not resumed:
                return None
        except (InputFileError, PluginError) as error:
            self._warn(f"lanes start anew: {error}")
            return None
        self._mapper = mapper
        return mapper.finish()
