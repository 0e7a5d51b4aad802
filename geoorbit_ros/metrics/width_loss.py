"""The paper's geometry loss: squared differences of lane widths (section IV-A)."""

from __future__ import annotations

import numpy as np

from geoorbit_ros.metrics.lane_pairs import LanePairs


def width_loss(pairs: LanePairs) -> float:
    """L_geometry = sum over M of |s_w - c_w|^2, in square metres.

    M are the reference lanes, s_w the width of the detected counterpart, c_w the reference width.
    """
    return float(np.sum((pairs.detected_width_m - pairs.reference_width_m) ** 2))
