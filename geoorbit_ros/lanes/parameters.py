"""Theta: the lane estimator's parameters that the meta-learner predicts for each camera."""

from __future__ import annotations

from dataclasses import dataclass, fields

from geoorbit_ros.core.errors import ParameterError

BOUNDS: dict[str, tuple[float, float]] = {
    "smoothing": (1.0, 20.0),
    "angle": (0.0, 1.0),
    "width_scale": (0.5, 2.0),
}
"""Ranges of theta: those of smoothing and angle are the paper's (section III-A). That of the width
scale is chosen: half to twice what is measured."""


@dataclass(frozen=True, slots=True)
class LaneParameters:
    """The paper's theta (section III-B); both estimators take it.

    Attributes:
        smoothing: theta_smoothing in [1, 20]: governs the histogram's bin count and the spline's
            smoothing (the range is the paper's, section III-A).
        angle: theta_angle in [0, 1]: governs how prominent a lateral peak must be.
        width_scale: Factor on the measured lane width; 1 is the paper's w = 2 sigma.

    Raises:
        ParameterError: A value outside its bounds.
    """

    smoothing: float = 10.0
    angle: float = 0.5
    width_scale: float = 1.0

    def __post_init__(self) -> None:
        for f in fields(self):
            value, (low, high) = getattr(self, f.name), BOUNDS[f.name]
            if not low <= value <= high:
                raise ParameterError(f"lane parameter '{f.name}'", value, f"{low} to {high}")
