"""Lane maps in the formats of other programs: OpenDRIVE, Lanelet2, SUMO."""

from __future__ import annotations

from geoorbit_ros import __version__
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.lanes.geojson import LaneFile


def file_facts(file: LaneFile) -> dict[str, str]:
    """Attributes of the whole map, as text."""
    return {
        "geoorbit:generator": f"geoorbit {__version__}",
        "geoorbit:camera_id": file.camera_id,
        "geoorbit:estimator": file.estimator,
        "geoorbit:stamp_ns": str(file.lane_map.stamp_ns),
    }


def lane_facts(lane: Lane) -> dict[str, str]:
    """Attributes of one lane, as text, with the names of `lanes.geojson`."""
    return {
        "geoorbit:lane_id": str(lane.lane_id),
        "geoorbit:status": lane.status,
        "geoorbit:confidence": f"{lane.confidence:.6f}",
        "geoorbit:width_m": f"{lane.width_m:.3f}",
        "geoorbit:width_sigma_m": f"{lane.width_sigma_m:.3f}",
        "geoorbit:vehicles": f"{lane.vehicles:.3f}",
    }
