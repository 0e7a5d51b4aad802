"""Coordinates of map projections: which one a file is in, and the way to latitude and longitude."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS, Geod, Transformer
from pyproj.aoi import AreaOfInterest
from pyproj.database import query_crs_info
from pyproj.enums import PJType
from pyproj.exceptions import CRSError, ProjError

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.errors import CalibrationError

Array = NDArray[np.float64]

NEAR_M = 20_000.0
"""Points so near to the datum are counted from it, or in a projection that puts them there. Chosen:
larger takes a wrong projection by chance (there are some 50 per place, hundreds of kilometres from
each other), smaller refuses a datum that is only the town's."""
SAME_M = 10.0
"""Projections that put points less than this apart are the same for a map: they differ by the
realisation of their datum (NAD83 and NAD83(HARN): 1 m)."""
RIVAL_M = 2_000.0
"""A second projection that puts the points at most so much farther from the datum could be meant as
well. Chosen: larger refuses what is clear, smaller trusts that the datum is exact."""
FAR_M = 100_000.0
"""A datum farther away than this is not the camera's: local metres are 1.2e-4 too long there, and
positions in single precision are rounded to 8 mm."""
WEB_MERCATOR = 3857
_EPSG = re.compile(r"EPSG\W{0,3}(\d{4,6})", re.IGNORECASE)
_CRS = re.compile(r"#\s*(?:CRS|WKT|PROJ\w*)?\s*[:=]?\s*((?:[A-Z]{5,}\[|\+proj=).+)")
"""A comment with the projection in WKT or as PROJ writes it; QGIS puts one above its points."""
_ELLIPSOID = Geod(ellps="WGS84")


@dataclass(frozen=True, slots=True)
class Projection:
    """A coordinate reference system.

    Attributes:
        definition: What PROJ makes it from: `EPSG:32630`, WKT or `+proj=…`.
        name: For people.
        exchanged: The file's first coordinate is the northing.
    """

    definition: str
    name: str
    exchanged: bool = False

    def to_geodetic(self, xy: Array) -> Array:
        """[latitude, longitude] in degrees, (N, 2); not finite where there is none."""
        x, y = xy.T[::-1] if self.exchanged else xy.T
        longitude, latitude = _to_wgs84(self.definition).transform(x, y)
        return np.column_stack((latitude, longitude))


def named_projection(comments: Sequence[str], place: str) -> Projection | None:
    """The projection that a comment of a file names, e.g. `# CRS: EPSG:25832`; None for none.

    Raises:
        CalibrationError: It names one that doesn't exist.
    """
    for comment in comments:
        code, text = _EPSG.search(comment), _CRS.match(comment)
        definition = text[1] if text else f"EPSG:{code[1]}" if code else None
        if definition is None:
            continue
        try:
            name = CRS.from_user_input(definition).name
            _to_wgs84(definition)
        except (CRSError, ProjError):
            expected = "a known projection such as EPSG:25832"
            raise CalibrationError(place, f"'{definition[:60]}'", expected) from None
        return Projection(definition, name)
    return None


def projection_near(xy: Array, datum: Datum, place: str) -> Projection | None:
    """The projection in which points lie at a datum; None where there is none.

    UTM of WGS 84 in the datum's zone and its neighbours, and Web Mercator, go first; then all that
    the EPSG registry has for the place.

    Args:
        xy: (N, 2) coordinates.
        datum: About where the points are.
        place: For the error.

    Raises:
        CalibrationError: Several could be meant, kilometres or hundreds of metres apart.
    """
    middle = np.median(xy, axis=0)[None, :]
    for candidates in (_worldwide(datum), _registered(datum)):
        found = [(_distance_m(known, middle, datum), known) for known in candidates]
        near = sorted(
            (pair for pair in found if pair[0] <= NEAR_M), key=lambda pair: round(pair[0])
        )
        if not near:
            continue
        nearest_m, nearest = near[0]
        at = Datum(*nearest.to_geodetic(middle)[0])
        for distance_m, other in near[1:]:
            apart_m = _distance_m(other, middle, at)
            if apart_m > SAME_M and distance_m <= nearest_m + RIVAL_M:
                raise CalibrationError(
                    place,
                    f"x and y of {nearest.name} ({nearest.definition}) or of {other.name} "
                    f"({other.definition}), {apart_m:.0f} m apart",
                    f"a line '# CRS: {nearest.definition}' above the header that says which",
                )
        return nearest
    return None


def ground_distance_m(a: Sequence[float] | Array, b: Sequence[float] | Array) -> float:
    """Metres along the ellipsoid between two positions [latitude, longitude] in degrees."""
    return float(_ELLIPSOID.inv(a[1], a[0], b[1], b[0])[2])


def _worldwide(datum: Datum) -> Iterator[Projection]:
    zone = int((datum.longitude_deg + 180.0) // 6.0)
    for number in (zone, zone - 1, zone + 1):
        for base, hemisphere in ((32601, "N"), (32701, "S")):
            name = f"WGS 84 / UTM zone {number % 60 + 1}{hemisphere}"
            yield from _both_ways(f"EPSG:{base + number % 60}", name)
    yield from _both_ways(f"EPSG:{WEB_MERCATOR}", "WGS 84 / Pseudo-Mercator")


def _registered(datum: Datum) -> Iterator[Projection]:
    longitude, latitude = datum.longitude_deg, datum.latitude_deg
    area = AreaOfInterest(longitude, latitude, longitude, latitude)
    kinds = PJType.PROJECTED_CRS
    for known in query_crs_info("EPSG", kinds, area_of_interest=area, contains=True):
        if not known.deprecated:
            yield from _both_ways(f"EPSG:{known.code}", known.name)


def _both_ways(definition: str, name: str) -> Iterator[Projection]:
    """Surveyors' x is the northing in some countries."""
    yield Projection(definition, name)
    yield Projection(definition, name, exchanged=True)


def _distance_m(projection: Projection, middle: Array, datum: Datum) -> float:
    """From the datum to a point (1, 2); infinite where the projection doesn't reach."""
    try:
        at = projection.to_geodetic(middle)[0]
    except ProjError:
        return float("inf")
    if not np.isfinite(at).all():
        return float("inf")
    return ground_distance_m(at, (datum.latitude_deg, datum.longitude_deg))


@lru_cache(maxsize=256)
def _to_wgs84(definition: str) -> Transformer:
    return Transformer.from_crs(definition, "EPSG:4326", always_xy=True)
