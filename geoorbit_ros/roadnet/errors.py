"""What can be wrong with a road network."""

from __future__ import annotations

from geoorbit_ros.core.errors import GeoOrbitError


class RoadNetworkError(GeoOrbitError):
    """A road network, or a map to make one of, that can't be used; or SUMO is not installed."""
