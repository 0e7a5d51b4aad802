"""Converts coordinates between the map frame and a network's own projection, fast and conformal."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.errors import RoadNetworkError

Complex = NDArray[np.complex128]

DEGREE = 5
"""Of the polynomial. Chosen: the error over some tens of kilometres stays below `MAX_ERROR_M`,
which is checked for every network; a higher degree costs time in every step."""
MAX_ERROR_M = 1e-3
"""A network with a larger error is refused. Chosen: far below the errors of tracks (decimetres);
larger admits networks too wide for one plane."""
MARGIN_M = 200.0
"""The polynomial holds this far beyond the network. Chosen: vehicles are placed beside it, too;
larger fits the network itself a little less well."""
_GRID = 9
"""Points per side that the polynomial is fitted to. Chosen: 81 points for 6 coefficients."""


class ConformalMap:
    """Converts points of one conformal plane to another, by a polynomial in x + iy.

    A map that keeps angles is an analytic function (Gauss 1822; Krueger 1912 uses the same
    series for transverse Mercator), so its derivative is the scale and the rotation at a point.

    Args:
        source: (N, 2) points.
        target: (N, 2) the same points in the other plane.
    """

    def __init__(self, source: NDArray[np.float64], target: NDArray[np.float64]) -> None:
        z, w = _complex(source), _complex(target)
        self._origin = complex(z.mean())
        self._scale = float(max(np.abs(z - self._origin).max(), 1.0))
        t = (z - self._origin) / self._scale
        powers = np.vander(t, DEGREE + 1, increasing=True)
        self._coefficients = np.linalg.lstsq(powers, w, rcond=None)[0]
        self.error_m = float(np.abs(powers @ self._coefficients - w).max())

    def points(self, xy: ArrayLike) -> NDArray[np.float64]:
        """(N, 2) points in the target plane."""
        t = (_complex(xy) - self._origin) / self._scale
        w = np.full(t.shape, self._coefficients[-1])
        for c in self._coefficients[-2::-1]:
            w = w * t + c
        return np.column_stack((w.real, w.imag))

    def turn_rad(self, xy: ArrayLike) -> NDArray[np.float64]:
        """(N,) angle to add to a heading at each point."""
        t = (_complex(xy) - self._origin) / self._scale
        c = self._coefficients
        slope = np.zeros(t.shape, np.complex128)
        for k in range(DEGREE, 0, -1):
            slope = slope * t + k * c[k]
        return np.asarray(np.angle(slope), dtype=np.float64)


class NetworkPlane:
    """Converts between the map frame at a datum and a SUMO network's coordinates.

    Args:
        projection: PROJ definition from the network's `location`.
        net_offset: (x, y) that SUMO adds to projected coordinates.
        bounds: (x_min, y_min, x_max, y_max) of the network in its own coordinates.
        datum: Origin of the map frame.
        place: The network file, for errors.

    Attributes:
        to_map, to_network: The two directions.

    Raises:
        RoadNetworkError: A projection that PROJ doesn't know or that keeps no angles, or a network
            so large that one plane doesn't fit it.
    """

    def __init__(
        self,
        projection: str,
        net_offset: tuple[float, float],
        bounds: tuple[float, float, float, float],
        datum: Datum,
        place: str,
    ) -> None:
        x = np.linspace(bounds[0] - MARGIN_M, bounds[2] + MARGIN_M, _GRID)
        y = np.linspace(bounds[1] - MARGIN_M, bounds[3] + MARGIN_M, _GRID)
        grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        shifted = grid - net_offset
        try:
            projected = Transformer.from_crs(CRS(projection), "EPSG:4326", always_xy=True)
            longitude, latitude = projected.transform(shifted[:, 0], shifted[:, 1], errcheck=True)
        except ProjError as error:
            raise RoadNetworkError(
                place, f"projection '{projection}'", "a PROJ definition such as +proj=utm +zone=16"
            ) from error
        local = datum.to_local(latitude, longitude)
        if not np.isfinite(local).all():
            far = f"a datum at {datum.latitude_deg:.4f}, {datum.longitude_deg:.4f}"
            raise RoadNetworkError(place, far, "a datum near the network")
        self.to_map = ConformalMap(grid, local)
        self.to_network = ConformalMap(local, grid)
        error_m = max(self.to_map.error_m, self.to_network.error_m)
        if error_m > MAX_ERROR_M:
            raise RoadNetworkError(
                place,
                f"projection '{projection}', {error_m:.3g} m off the map's plane",
                "a conformal projection (UTM, tmerc, …) and a datum near the network",
            )


def _complex(xy: ArrayLike) -> Complex:
    points = np.asarray(xy, dtype=np.float64).reshape(-1, 2)
    return np.asarray(points[:, 0] + 1j * points[:, 1], dtype=np.complex128)
