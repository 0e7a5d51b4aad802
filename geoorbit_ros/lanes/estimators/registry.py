"""Estimators by the name that users give."""

from __future__ import annotations

from collections.abc import Callable

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.core.plugins import FORM, is_own_class, make_own
from geoorbit_ros.lanes.estimators.curvilinear.estimator import CurvilinearEstimator
from geoorbit_ros.lanes.estimators.estimator import LaneEstimator

METHODS = ("add", "lanes", "update", "state", "restore")


def _geolane() -> LaneEstimator:
    # Imported when asked for: scikit-learn takes a second to load, the default needs none of it.
    from geoorbit_ros.lanes.estimators.geolane import GeoLaneEstimator

    return GeoLaneEstimator()


ESTIMATORS: dict[str, Callable[[], LaneEstimator]] = {
    "curvilinear": CurvilinearEstimator,
    "geolane": _geolane,
}


def make_estimator(name: str) -> LaneEstimator:
    """A fresh estimator, by its name or as `FILE.py:CLASS`.

    Raises:
        ParameterError: No estimator has this name, or the file has no such class.
    """
    if is_own_class(name):
        own: LaneEstimator = make_own(name, "parameter 'estimator'", METHODS)
        return own
    if name not in ESTIMATORS:
        raise ParameterError(
            "parameter 'estimator'", repr(name), " or ".join([*sorted(ESTIMATORS), FORM])
        )
    return ESTIMATORS[name]()
