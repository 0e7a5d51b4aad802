"""The origin of a camera's `map` frame and the way from degrees to metres and back."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoorbit_ros.core.errors import CalibrationError, ParameterError

if TYPE_CHECKING:
    from pyproj import Transformer


@dataclass(frozen=True, slots=True)
class Datum:
    """Origin of a local east-north-up plane (REP-103, REP-105 `map`), WGS 84.

    The plane is a transverse Mercator projection centred on the origin with scale one. Within
    5 km of it, lengths are true to 3e-7, far below what a camera sees.

    Attributes:
        latitude_deg: Latitude of (0, 0), -90 to 90.
        longitude_deg: Longitude of (0, 0), -180 to 180.

    Raises:
        CalibrationError: A coordinate outside its range, or not finite.
    """

    latitude_deg: float
    longitude_deg: float

    def __post_init__(self) -> None:
        for name, value, bound in (
            ("latitude", self.latitude_deg, 90.0),
            ("longitude", self.longitude_deg, 180.0),
        ):
            if not abs(value) <= bound:
                raise CalibrationError(
                    f"datum, {name}", value, f"degrees from {-bound:g} to {bound:g}"
                )

    @property
    def proj_string(self) -> str:
        """The plane as a PROJ definition, for GIS software and OpenDRIVE headers."""
        return (
            f"+proj=tmerc +lat_0={self.latitude_deg!r} +lon_0={self.longitude_deg!r} "
            "+k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs"
        )

    def to_local(self, latitude_deg: ArrayLike, longitude_deg: ArrayLike) -> NDArray[np.float64]:
        """Metres east and north of the datum, (N, 2), of N WGS 84 positions."""
        latitude = np.atleast_1d(np.asarray(latitude_deg, dtype=np.float64))
        longitude = np.atleast_1d(np.asarray(longitude_deg, dtype=np.float64))
        east, north = _transformer(self.proj_string).transform(longitude, latitude)
        return np.column_stack((east, north)).astype(np.float64, copy=False)

    def to_geodetic(self, local_m: ArrayLike) -> NDArray[np.float64]:
        """[latitude, longitude] in degrees, (N, 2), of N points `local_m` (N, 2)."""
        local = np.asarray(local_m, dtype=np.float64).reshape(-1, 2)
        longitude, latitude = _transformer(self.proj_string).transform(
            local[:, 0], local[:, 1], direction="INVERSE"
        )
        return np.column_stack((latitude, longitude)).astype(np.float64, copy=False)


@lru_cache(maxsize=64)
def _transformer(proj_string: str) -> Transformer:
    """Making one takes milliseconds, using it microseconds."""
    # Here, because it takes a tenth of a second, and most nodes and commands never come by.
    from pyproj import Transformer

    return Transformer.from_crs("EPSG:4326", proj_string, always_xy=True)


def given_datum(latitude_deg: float, longitude_deg: float, place: str) -> Datum | None:
    """The datum of two parameters; None when both are NaN.

    Raises:
        ParameterError: One of them only.
    """
    given = [not math.isnan(value) for value in (latitude_deg, longitude_deg)]
    if any(given) and not all(given):
        expected = "both latitude and longitude, or neither"
        raise ParameterError(f"{place}, parameters datum_…_deg", "one of them", expected)
    return Datum(latitude_deg, longitude_deg) if all(given) else None
