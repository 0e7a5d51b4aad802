"""The bounded space of theta: between lane-estimator parameters and the unit cube."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.lanes.parameters import BOUNDS, LaneParameters

Array = NDArray[np.float64]

PARAMETER_NAMES: tuple[str, ...] = tuple(BOUNDS)
"""Order of theta in every vector, output head and payload."""
_LOGARITHMIC = frozenset({"smoothing", "width_scale"})
"""Factors: from 1 to 2 is as far as from 10 to 20."""


def to_unit(parameters: LaneParameters | Mapping[str, float]) -> Array:
    """Theta as (P,) numbers in [0, 1], in the order of `PARAMETER_NAMES`."""
    values = parameters if isinstance(parameters, Mapping) else asdict(parameters)
    return np.array([_to_unit(name, values[name]) for name in PARAMETER_NAMES])


def from_unit(unit: Sequence[float] | Array) -> LaneParameters:
    """The lane-estimator parameters at a point of the unit cube; `to_unit`'s inverse.

    Raises:
        ParameterError: Not one finite number per parameter.
    """
    unit = np.asarray(unit, dtype=np.float64)
    if unit.shape != (len(PARAMETER_NAMES),) or not np.isfinite(unit).all():
        found = f"{unit.tolist()}"
        raise ParameterError("theta", found, f"{len(PARAMETER_NAMES)} finite numbers")
    values = {}
    for name, u in zip(PARAMETER_NAMES, np.clip(unit, 0.0, 1.0), strict=True):
        low, high = BOUNDS[name]
        value = low * (high / low) ** u if name in _LOGARITHMIC else low + (high - low) * u
        values[name] = float(min(max(value, low), high))
    return LaneParameters(**values)


def _to_unit(name: str, value: float) -> float:
    low, high = BOUNDS[name]
    if name in _LOGARITHMIC:
        return float(np.log(value / low) / np.log(high / low))
    return (value - low) / (high - low)


DEFAULT_UNIT = to_unit(LaneParameters())
"""The fixed parameters of the baseline."""
