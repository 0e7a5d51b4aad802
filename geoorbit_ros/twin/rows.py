"""The twin's vehicles as rows of the table that all tracks travel in."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.tables import FLAG_PREDICTED, TRACK_DTYPE
from geoorbit_ros.twin.placement import TwinStep
from geoorbit_ros.twin.vehicle_types import TYPES


def track_rows(step: TwinStep) -> NDArray[np.void]:
    """(M,) `TRACK_DTYPE`; `track_id` is the vehicle's id, `FLAG_PREDICTED` where it is not seen."""
    kept = np.isfinite(step.xy[:, 0])
    rows = np.zeros(int(np.count_nonzero(kept)), TRACK_DTYPE)
    rows["x"], rows["y"] = step.xy[kept].T
    rows["vx"], rows["vy"] = step.velocity[kept].T
    rows["heading"], rows["sigma"] = step.heading_rad[kept], step.sigma_m[kept]
    rows["length"], rows["width"] = step.size_m[kept].T
    rows["score"] = 1.0
    rows["class_id"] = np.array([kind.coco_class for kind in TYPES])[step.kind[kept]]
    rows["track_id"] = step.vehicle_id[kept]
    rows["flags"] = np.where(step.observed[kept], 0, FLAG_PREDICTED)
    return rows
