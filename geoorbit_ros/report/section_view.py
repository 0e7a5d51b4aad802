"""Lateral histograms: where across the road the vehicles drive, with the lanes' peaks."""

from __future__ import annotations

import numpy as np

from geoorbit_ros.core.lanes import CrossSection, LaneMap
from geoorbit_ros.report.lane_drawing import DIRECTION_GAP_DEG, direction_groups
from geoorbit_ros.report.svg import Canvas, nice_step
from geoorbit_ros.report.words import compass

WIDTH_PX, HEIGHT_PX = 1040.0, 220.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 48.0, 16.0, 26.0, 40.0
_EMPTY = 0.01
"""Bins below this share of the highest one are empty road, not worth drawing."""


def section_view(section: CrossSection, lane_map: LaneMap) -> Canvas:
    """Draw one direction's histogram as the driver sees the road, left on the left."""
    canvas = Canvas(
        WIDTH_PX, HEIGHT_PX, f"Traffic across the road towards {compass(section.heading_deg)}"
    )
    colour = _colour(section, lane_map)
    top = max(float(section.density.max(initial=0.0)), 1e-9)
    used = section.offset_m[section.density > _EMPTY * top]
    ends = np.concatenate((used, section.peak_m))
    low, high = (ends.min() - 2.0, ends.max() + 2.0) if len(ends) else (-5.0, 5.0)
    wide = (WIDTH_PX - _LEFT - _RIGHT) / (high - low)
    base = HEIGHT_PX - _BOTTOM

    def x(offset_m: float) -> float:
        return float(_LEFT + (high - offset_m) * wide)

    step = nice_step(high - low, 12)
    for tick in np.arange(np.ceil(low / step) * step, high, step):
        canvas.line(np.array([[x(tick), base], [x(tick), base + 4]]), "axis")
        canvas.text(x(tick), base + 17, f"{tick + 0.0:g}", "label", "middle")
    canvas.text(_LEFT, HEIGHT_PX - 6, "← driver's left", "label")
    canvas.text(WIDTH_PX - _RIGHT, HEIGHT_PX - 6, "driver's right →", "label", "end")
    middle = (WIDTH_PX + _LEFT - _RIGHT) / 2
    canvas.text(middle, HEIGHT_PX - 6, "metres across the road", "label", "middle")

    inside = (section.offset_m >= low) & (section.offset_m <= high)
    across, density = section.offset_m[inside], section.density[inside]
    tall = (base - _TOP) / top
    curve = np.column_stack((_LEFT + (high - across) * wide, base - density * tall))
    if len(curve) > 1:
        foot = np.array([[curve[-1, 0], base], [curve[0, 0], base]])
        canvas.area(np.vstack((curve, foot)), f"histogram d{colour}")
        canvas.line(curve, f"centerline confirmed d{colour}")
    canvas.line(np.array([[_LEFT, base], [WIDTH_PX - _RIGHT, base]]), "axis")
    canvas.text(_LEFT - 6, _TOP + 4, f"{top:.2g}", "label", "end")
    canvas.text(_LEFT - 6, base, "0", "label", "end")
    canvas.text(_LEFT - 42, 12, "vehicles per metre", "label")

    peaks = np.sort(section.peak_m)[::-1]
    for k, peak in enumerate(peaks):
        canvas.line(np.array([[x(peak), _TOP - 6], [x(peak), base]]), "peak")
        if k:
            gap = peaks[k - 1] - peak
            canvas.text(
                (x(peaks[k - 1]) + x(peak)) / 2, _TOP - 8, f"{gap:.2f} m", "label", "middle"
            )
    return canvas


def _colour(section: CrossSection, lane_map: LaneMap) -> int:
    colour = direction_groups(lane_map.lanes)
    gap = {
        lane.lane_id: abs((lane.heading_deg - section.heading_deg + 180.0) % 360.0 - 180.0)
        for lane in lane_map.lanes
    }
    nearest = min(gap, key=gap.__getitem__, default=None)
    if nearest is None or gap[nearest] > DIRECTION_GAP_DEG:
        return 5
    return colour[nearest]
