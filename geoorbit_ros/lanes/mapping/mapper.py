"""Continuous mapping: asks an estimator on a schedule of data time, and keeps the lanes' history.

An estimator derives lanes and remembers none. Here lanes get lasting ids, confirmed lanes stay
confirmed, weak new lanes are hidden, and most updates only count new vehicles.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.core.lanes import LaneMap
from geoorbit_ros.core.tables import FLAG_DOUBTFUL, Frames
from geoorbit_ros.lanes.confidence import SHOW, keep_confirmed, unconfirmed
from geoorbit_ros.lanes.estimators.estimator import LaneEstimator, Restorable, State
from geoorbit_ros.lanes.mapping.lane_ids import LaneRegistry
from geoorbit_ros.lanes.mapping.update_policy import UpdatePolicy
from geoorbit_ros.lanes.parameters import LaneParameters

DEFAULT_UPDATE_PERIOD_S = 5.0
"""Chosen: a longer period shows lanes later, a shorter one costs more time."""
ESTIMATOR_PREFIX = "estimator_"
"""Begins the names of the estimator's arrays in a saved state."""


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
        self._stamp_ns = 0
        self._ids = LaneRegistry()
        self._policy = UpdatePolicy(estimator)
        self._flags: NDArray[np.integer] = np.empty(0, np.int32)

    def add(self, stamp_ns: int, rows: NDArray[np.void]) -> LaneMap | None:
        """Take one frame; the renewed map when a period has passed, else None.

        Args:
            stamp_ns: Capture time, later than that of the call before.
            rows: (N,) `TRACK_DTYPE`.
        """
        self.estimator.add(stamp_ns, rows)
        return self._added(stamp_ns, rows)

    def add_block(self, frames: Frames) -> LaneMap | None:
        """Take many frames as one after the other; the last map that was renewed, None for none.

        Args:
            frames: Frames of `TRACK_DTYPE`, later than those before.
        """
        newest, first = None, 0
        while first < len(frames):
            # Up to the first frame that the estimator is asked after.
            due_ns = frames.stamp_ns[first] if self._due_ns is None else self._due_ns
            last = min(int(np.searchsorted(frames.stamp_ns, due_ns)) + 1, len(frames))
            part = frames.part(first, last)
            for stamp_ns, rows in part.tables():
                self.estimator.add(stamp_ns, rows)
            some = np.flatnonzero(np.diff(part.offset))
            rows = part.frame(int(some[-1]) if len(some) else -1)
            newest = self._added(int(part.stamp_ns[-1]), rows) or newest
            first = last
        return newest

    def _added(self, stamp_ns: int, rows: NDArray[np.void]) -> LaneMap | None:
        """See `add`; the estimator has the frame."""
        if len(rows):
            self._flags = rows["flags"]
        self._stamp_ns = stamp_ns
        if self._due_ns is None:
            self._due_ns = stamp_ns + self._period_ns
        if stamp_ns < self._due_ns:
            return None
        periods = (stamp_ns - self._due_ns) // self._period_ns + 1
        self._due_ns += periods * self._period_ns
        return self.renew()

    @property
    def doubtful(self) -> bool:
        """Whether the latest rows say that something speaks against them (`FLAG_DOUBTFUL`).

        While they do, no lane is shown as confirmed.
        """
        return bool((self._flags & FLAG_DOUBTFUL).any())

    def renew(self) -> LaneMap:
        """The map of all frames so far: derived anew where that is worth it, else counted on."""
        counted = self._policy.count(self._stamp_ns, self.parameters)
        if counted is None:
            return self.finish()
        self._ids.identify(counted.lanes, counted.lanes)
        return unconfirmed(counted) if self.doubtful else counted

    def finish(self) -> LaneMap:
        """The map of all frames so far, derived anew."""
        found = self.estimator.lanes(self.parameters)
        matched = self._ids.match(found.lanes)
        pairs = [
            (keep_confirmed(lane, before), before)
            for lane, before in zip(found.lanes, matched, strict=True)
            if before is not None or lane.confidence >= SHOW
        ]
        named = self._ids.identify([lane for lane, _ in pairs], [before for _, before in pairs])
        lane_map = replace(found, lanes=tuple(sorted(named, key=lambda lane: lane.lane_id)))
        self._policy.derived(lane_map, self.parameters)
        return unconfirmed(lane_map) if self.doubtful else lane_map

    def state(self) -> State:
        """The lanes with their ids, and what the estimator remembers if it is `Restorable`."""
        state = self._ids.state()
        if isinstance(self.estimator, Restorable):
            own = self.estimator.state()
            state |= {ESTIMATOR_PREFIX + name: array for name, array in own.items()}
        return state

    def restore(self, state: Mapping[str, NDArray[Any]], stamp_ns: int) -> None:
        """Go on from a state; the next frame comes at `stamp_ns`.

        Raises:
            KeyError, ValueError, IndexError: Not such a state.
        """
        self._ids.restore(state)
        if isinstance(self.estimator, Restorable):
            own = {
                name.removeprefix(ESTIMATOR_PREFIX): array
                for name, array in state.items()
                if name.startswith(ESTIMATOR_PREFIX)
            }
            self.estimator.restore(own, stamp_ns)


def derive_once(estimator: LaneEstimator, parameters: LaneParameters) -> LaneMap:
    """The lanes that a mapper without history would show, with new ids.

    Args:
        estimator: One that has been given all rows.
        parameters: Theta.
    """
    return LaneMapper(estimator, parameters).finish()
