"""Estimators by the name that users give."""

from __future__ import annotations

from collections.abc import Callable

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.lanes.curvilinear import CurvilinearEstimator
from geoorbit_ros.lanes.estimator import LaneEstimator


def _geolane() -> LaneEstimator:
    # Imported when asked for: scikit-learn takes a second to load, the default needs none of it.
    from geoorbit_ros.lanes.geolane import GeoLaneEstimator

    return GeoLaneEstimator()


ESTIMATORS: dict[str, Callable[[], LaneEstimator]] = {
    "curvilinear": CurvilinearEstimator,
    "geolane": _geolane,
}


def make_estimator(name: str) -> LaneEstimator:
    """A fresh estimator.

    Raises:
        ParameterError: No estimator has this name.
    """
    if name not in ESTIMATORS:
        raise ParameterError("parameter 'estimator'", repr(name), " or ".join(sorted(ESTIMATORS)))
    return ESTIMATORS[name]()
