"""geolane stays among its points at the corners of theta, where the search goes."""

from __future__ import annotations

import numpy as np
import pytest
from tasks import made_task

from geoorbit_ros.learning.objective import detect_lanes


@pytest.mark.parametrize("smoothing", [0.6, 1.0])
@pytest.mark.parametrize("heading_rad", [0.0, 0.4])
def test_centrelines_stay_near_the_vehicles(smoothing: float, heading_rad: float) -> None:
    task = made_task(heading_rad=heading_rad, seed=4)
    lanes = detect_lanes(task, "geolane", [smoothing, 0.0, 0.5])
    assert lanes
    rows = task.tracks.rows
    for lane in lanes:
        north = lane.centerline_m[:, 1]
        reach = float(np.ptp(rows["y"]))
        assert np.all(north > rows["y"].min() - reach - 5.0)
        assert np.all(north < rows["y"].max() + reach + 5.0)
