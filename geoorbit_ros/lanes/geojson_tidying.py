"""Brings GeoJSON of other programs into the form of lane files, feature by feature."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, TypeGuard, get_args

import numpy as np
from pyproj import Transformer
from pyproj.exceptions import CRSError

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.input_report import InputReport, Treatment
from geoorbit_ros.core.lanes import Status

ROLE_NAMES = {"centreline": "centerline", "center": "centerline", "centre": "centerline"}
"""Other names of a role."""
JOINED_DEG = 5e-6
"""Parts of a line whose ends are this near are one line: half a metre."""
EXCHANGED_DEG = 1.0
"""Longitude and latitude are exchanged if this far from the datum as they stand, and nearer than
half of it the other way round: a hundred kilometres, where lanes lie within 20."""
_NUMBERS: dict[str, tuple[float, float]] = {
    "confidence": (0.0, 1.0),
    "width_m": (0.0, 100.0),
    "width_sigma_m": (0.0, 100.0),
    "driven_offset_m": (-20.0, 20.0),
    "vehicles": (0.0, np.inf),
    "vehicles_missing": (0.0, np.inf),
    "sigma_m": (0.0, 1e6),
}
"""Ranges of a lane's numbers in a file; values outside are not used."""


class Tidying:
    """Brings features of other programs into the form that is read here, and counts what it did.

    Args:
        path: The file, for errors.
        crs: The member `crs` of GeoJSON before RFC 7946.
        datum: The member `datum`, unchecked.
        features: All features, unchecked.

    Raises:
        InputFileError: The file names a reference system that is not known.
    """

    def __init__(self, path: Path, crs: Any, datum: Any, features: list[Any]) -> None:
        self._done: dict[str, list[int]] = {}
        self._features = len(features)
        # A file without any lane_id is numbered.
        self._numbered = not any(
            isinstance(f, dict)
            and isinstance(f.get("properties"), dict)
            and f["properties"].get("lane_id") is not None
            for f in features
        )
        self._crs, self._transform = _transformer(path, crs)
        self._exchanged = _exchanged(features, datum) and self._transform is None

    def tidied(self, k: int, feature: Any) -> Any:
        """Feature `k`, as a line with the usual names and WGS 84 coordinates where it can be."""
        if not isinstance(feature, dict) or not isinstance(feature.get("geometry"), dict):
            return feature
        properties = feature.get("properties")
        properties = dict(properties) if isinstance(properties, dict) else {}
        geometry = self._as_line(k, feature["geometry"])
        if self._numbered and len(properties.keys() & {"lane_id"}) == 0:
            properties["lane_id"] = k + 1
            self._did("no lane_id in the file: lanes are numbered in their order", k)
        if isinstance(text := properties.get("lane_id"), str) and text.strip().isdecimal():
            properties["lane_id"] = int(text)
            self._did("'lane_id': a number written as text", k)
        for key, names in (("role", ROLE_NAMES), ("status", {})):
            if isinstance(word := properties.get(key), str):
                properties[key] = names.get(word.strip().lower(), word.strip().lower())
        if "status" in properties and properties["status"] not in get_args(Status):
            self._did(f"'status': {properties.pop('status')!r}, taken as confirmed", k)
        for key, (low, high) in _NUMBERS.items():
            value = properties.get(key)
            if value is not None and not (is_number(value) and low <= value <= high):
                self._did(f"'{key}': {value!r} is not used, outside {low:g} to {high:g}", k)
                del properties[key]
        return {**feature, "properties": properties, "geometry": geometry}

    def tell(self, report: InputReport) -> None:
        """Note what was done."""
        for text, which in self._done.items():
            report.add(Treatment.REPAIRED, len(which), text, f"feature {which[0]}")

    def _did(self, text: str, k: int) -> None:
        self._done.setdefault(text, []).append(k)

    def _as_line(self, k: int, geometry: dict[str, Any]) -> dict[str, Any]:
        points = geometry.get("coordinates")
        if geometry.get("type") == "MultiLineString" and isinstance(points, list):
            if (joined := _joined(points)) is None:
                return geometry
            points = joined
            self._did("parts of a line (MultiLineString) are joined", k)
        elif geometry.get("type") != "LineString" or not isinstance(points, list):
            return geometry
        kept = [p for p in points if isinstance(p, list) and all(map(is_number, p[:2]))]
        if len(kept) < len(points) and len(kept) >= 2:
            self._did("points that are no numbers are left out", k)
            points = kept
        if self._exchanged and len(kept) == len(points):
            points = [[p[1], p[0], *p[2:]] for p in points]
            self._did("latitude stands first: exchanged", k)
        if self._transform is not None and len(kept) == len(points):
            x, y = self._transform.transform(*np.array([p[:2] for p in points]).T)
            points = np.column_stack((x, y)).tolist()
            self._did(f"coordinates of {self._crs} are converted", k)
        return {"type": "LineString", "coordinates": points}


def _transformer(path: Path, crs: Any) -> tuple[str, Transformer | None]:
    """Name of a file's reference system, and how to make WGS 84 of it; None: it is that."""
    if crs is None:
        return "", None
    try:
        name = str(crs["properties"]["name"])
        if name.endswith(("CRS84", ":4326")):
            return name, None
        return name, Transformer.from_crs(name, "EPSG:4326", always_xy=True)
    except (TypeError, KeyError, CRSError) as error:
        expected = "longitude and latitude, or a name such as EPSG:25832"
        raise InputFileError(f"{path}, 'crs'", repr(crs), expected) from error


def _exchanged(features: list[Any], datum: Any) -> bool:
    """Whether latitude stands before longitude, by the range of both or by the datum."""
    pairs = []
    for feature in features:
        geometry = feature.get("geometry") if isinstance(feature, dict) else None
        points = geometry.get("coordinates") if isinstance(geometry, dict) else None
        if isinstance(points, list) and points and isinstance(points[0], list):
            pair = points[0][:2]
            if len(pair) == 2 and all(map(is_number, pair)):
                pairs.append(pair)
    if not pairs:
        return False
    first, second = np.median(np.array(pairs, dtype=np.float64), axis=0)
    if abs(second) > 90.0 >= abs(first) and abs(second) <= 180.0:
        return True
    try:
        latitude, longitude = float(datum["latitude"]), float(datum["longitude"])
    except (TypeError, KeyError, ValueError):
        return False
    as_it_stands = max(abs(first - longitude), abs(second - latitude))
    other_way = max(abs(second - longitude), abs(first - latitude))
    return bool(as_it_stands > EXCHANGED_DEG and other_way < 0.5 * EXCHANGED_DEG)


def _joined(parts: list[Any]) -> list[Any] | None:
    """One line of the parts of a MultiLineString, None where they don't meet."""
    line: list[Any] = []
    for part in parts:
        if not isinstance(part, list) or not all(
            isinstance(p, list) and len(p) >= 2 and all(map(is_number, p[:2])) for p in part
        ):
            return None
        if line and part:
            gap = max(abs(line[-1][0] - part[0][0]), abs(line[-1][1] - part[0][1]))
            if gap > JOINED_DEG:
                return None
            part = part[1:]
        line += part
    return line


def is_number(value: object) -> TypeGuard[float]:
    """Whether a value of JSON is a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    # A whole number of hundreds of digits is no float: it can be compared with one all the same.
    return -sys.float_info.max <= value <= sys.float_info.max
