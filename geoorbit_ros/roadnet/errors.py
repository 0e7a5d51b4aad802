"""What can be wrong with a twin's inputs and its simulation."""

from __future__ import annotations

from geoorbit_ros.core.errors import GeoOrbitError


class RoadNetworkError(GeoOrbitError):
    """A road network, or a map to make one of, that can't be used."""


class SimulationError(GeoOrbitError):
    """SUMO did not start, refused something, or is gone."""


class CarlaError(GeoOrbitError):
    """CARLA's client is not there, or its server does not answer, or refuses something."""
