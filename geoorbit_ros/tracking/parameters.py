"""Parameters of the tracker."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from geoorbit_ros.core.errors import ParameterError

_BOUNDS: dict[str, tuple[float, float]] = {
    "high_score": (0.0, 1.0),
    "low_score": (0.0, 1.0),
    "birth_score": (0.0, 1.0),
    "confirm_hits": (1, 100),
    "confirm_score": (0.0, 1.0),
    "max_gap_s": (0.0, 60.0),
    "predict_s": (0.0, 60.0),
    "image_width": (0, 32768),
    "image_height": (0, 32768),
    "first_id": (1, 2**31 - 1),
}
"""Smallest and largest value of each parameter. Chosen: shares are from 0 to 1, longer times than a
minute have no use."""


@dataclass(frozen=True, slots=True)
class TrackerParameters:
    """Defaults were chosen on simulated scenes; docs/tracking.md says how.

    Attributes:
        high_score: Detections from this score on are associated first.
        low_score: Those from here to `high_score` continue tracks that found none of the first;
            weaker ones are ignored.
        birth_score: Score that begins a track.
        confirm_hits: Observations, a tenth of a second apart, after which a track gets its id and
            is published.
        confirm_score: Score above which those of one tenth of a second are enough.
        max_gap_s: A track unobserved for longer has ended.
        predict_s: Unobserved tracks are published, flagged as predicted, for this long.
        image_width: Of the camera's image in pixels, 0 when unknown: with it boxes cut by the
            border are flagged, and tracks that leave the image end.
        image_height: See `image_width`.
        first_id: Id of the first track.

    Raises:
        ParameterError: A value out of its bounds.
    """

    high_score: float = 0.42
    low_score: float = 0.1
    birth_score: float = 0.42
    confirm_hits: int = 2
    confirm_score: float = 0.75
    max_gap_s: float = 1.5
    predict_s: float = 0.4
    image_width: int = 0
    image_height: int = 0
    first_id: int = 1

    def __post_init__(self) -> None:
        for field in fields(self):
            value, (low, high) = getattr(self, field.name), _BOUNDS[field.name]
            if not (math.isfinite(value) and low <= value <= high):
                expected = f"a value from {low:g} to {high:.10g}"
                raise ParameterError(f"tracker parameter '{field.name}'", f"{value:g}", expected)
        if (self.image_width == 0) != (self.image_height == 0):
            found = f"{self.image_width} x {self.image_height}"
            expected = "both in pixels, or both 0 for unknown"
            raise ParameterError(
                "tracker parameters 'image_width', 'image_height'", found, expected
            )


def first_id_at(stamp_ns: int) -> int:
    """First id of a tracker that starts at `stamp_ns`: tenths of a second, up to 2^31.

    A tracker that confirms fewer than ten tracks a second, day in, day out, and is started again
    later, repeats no id within the seven years after which the numbers come round.
    """
    return stamp_ns // 100_000_000 % (2**31 - 1) + 1
