"""Lane maps as GeoJSON (RFC 7946) in WGS-84 longitude/latitude: the file `lanes.geojson`.

One LineString feature per lane and role; docs/formats.md describes it for users. Written and read
back, every point is within a millimetre.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros import __version__
from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.input_report import InputReport
from geoorbit_ros.core.lane_order import lane_numbers
from geoorbit_ros.core.lanes import Lane, LaneEdge, LaneMap, ViewNote
from geoorbit_ros.lanes.geojson_reader import (
    EXPECTED,
    Collection,
    datum_of,
    lanes_of,
    load_collection,
    map_of,
    parse_collection,
)

FORMAT_VERSION = 1
"""Of lanes.geojson; raised when a reader of an earlier version would read it wrongly."""
DECIMALS = 9
"""Decimals of a degree: 1e-9 degrees of latitude is 0.11 mm."""


@dataclass(frozen=True, slots=True)
class LaneFile:
    """A lane map as read from a file.

    Attributes:
        lane_map: Lanes in metres around `datum`.
        datum: Origin of the map frame.
        camera_id: Camera that saw the lanes; empty when the file doesn't say.
        estimator: Method that found them; empty when the file doesn't say.
        report: What was repaired or left out.
    """

    lane_map: LaneMap
    datum: Datum
    camera_id: str = ""
    estimator: str = ""
    report: InputReport = field(default_factory=lambda: InputReport("lanes", "features"))


def lanes_to_geojson(
    lane_map: LaneMap, datum: Datum, *, camera_id: str = "", estimator: str = ""
) -> dict[str, Any]:
    """A FeatureCollection with three features per lane: centerline, left, right.

    Args:
        lane_map: Lanes in the map frame, metres.
        datum: Origin of the map frame.
        camera_id: Recorded in the `geoorbit` member.
        estimator: Recorded in the `geoorbit` member.
    """
    numbers = lane_numbers(lane_map.lanes)
    return {
        "type": "FeatureCollection",
        "geoorbit": {
            "format": FORMAT_VERSION,
            "generator": f"geoorbit {__version__}",
            "camera_id": camera_id,
            "estimator": estimator,
            "stamp_ns": lane_map.stamp_ns,
            **({"doubtful": True} if lane_map.doubtful else {}),
            **_view_members(lane_map.view),
            "datum": {"latitude": datum.latitude_deg, "longitude": datum.longitude_deg},
            "visible": _polygon(lane_map.visible_m, datum),
            "cross_sections": [
                {
                    "heading_deg": round(section.heading_deg, 3),
                    "offset_m": np.round(section.offset_m, 4).tolist(),
                    "density": np.round(section.density, 6).tolist(),
                    "peak_m": np.round(section.peak_m, 4).tolist(),
                }
                for section in lane_map.cross_sections
            ],
        },
        "features": [
            feature
            for lane in lane_map.lanes
            for feature in _lane_features(lane, numbers[lane.lane_id], datum, held=lane_map.held)
        ],
    }


def dumps_lanes(
    lane_map: LaneMap, datum: Datum, *, camera_id: str = "", estimator: str = ""
) -> str:
    """`lanes_to_geojson` as text, one feature per line."""
    collection = lanes_to_geojson(lane_map, datum, camera_id=camera_id, estimator=estimator)
    head = {key: value for key, value in collection.items() if key != "features"}
    features = ",\n".join(_compact(feature) for feature in collection["features"])
    return f'{_compact(head)[:-1]},"features":[\n{features}\n]}}\n'


def write_lanes(
    path: Path | str,
    lane_map: LaneMap,
    datum: Datum,
    *,
    camera_id: str = "",
    estimator: str = "",
) -> None:
    """Write `lanes.geojson`. The text is complete before the file is opened."""
    text = dumps_lanes(lane_map, datum, camera_id=camera_id, estimator=estimator)
    Path(path).write_text(text, encoding="utf-8")


def read_lane_file(
    path: Path | str, datum: Datum | None = None, *, strict: bool = False
) -> LaneFile:
    """Read `lanes.geojson`, `truth.geojson` or a third party's file with the same properties.

    Args:
        path: The file.
        datum: Origin of the map frame wanted; default: the file's own, else the mean of its points.
        strict: Whether any fault refuses the file.

    Returns:
        The lanes. Properties the file lacks become: role centerline, status confirmed, confidence
        1, `width_m` the distance between the boundaries (NaN without boundaries), `vehicles` NaN.

    Raises:
        InputFileError: Not such a file, most of it can't be used, or with `strict` any fault; names
            feature, key, value and expectation.
    """
    return _lane_file(load_collection(Path(path)), datum, strict)


def parse_lane_file(text: str, place: str, datum: Datum | None = None) -> LaneFile:
    """The same of a text that a program of this package wrote; errors call it `place`.

    Raises:
        InputFileError: Not the text of such a file, or any fault.
    """
    return _lane_file(parse_collection(text, Path(place)), datum, strict=True)


def _lane_file(collection: Collection, datum: Datum | None, strict: bool) -> LaneFile:
    collection.report.check(strict, EXPECTED)
    origin = datum or datum_of(collection)
    about = collection.about
    lanes = lanes_of(collection, origin)
    collection.report.check(strict, EXPECTED)
    return LaneFile(
        map_of(collection, origin, lanes),
        origin,
        str(about.get("camera_id", "")),
        str(about.get("estimator", "")),
        collection.report,
    )


def read_lanes(path: Path | str, datum: Datum | None = None) -> LaneMap:
    """The lane map of `read_lane_file`."""
    return read_lane_file(path, datum).lane_map


def _view_members(view: ViewNote | None) -> dict[str, Any]:
    if view is None:
        return {}
    about = {"held": view.held, "since_ns": view.since_ns, "why": view.why}
    return {**({"held": True} if view.held else {}), "view": about}


def _lane_features(
    lane: Lane, lane_number: int, datum: Datum, *, held: bool
) -> Iterator[dict[str, Any]]:
    properties = {
        "lane_number": lane_number,
        "status": lane.status,
        "confidence": _rounded(lane.confidence, 4),
        "width_m": _rounded(lane.width_m, 3),
        "width_sigma_m": _rounded(lane.width_sigma_m, 3),
        "heading_deg": _rounded(lane.heading_deg, 2),
        "vehicles": _rounded(lane.vehicles, 2),
        "vehicles_missing": lane.vehicles_missing,
        "sigma_m": _rounded(lane.sigma_m, 3),
        "length_m": _rounded(lane.length_m, 2),
    }
    if np.isfinite(lane.driven_offset_m):
        properties["driven_offset_m"] = _rounded(lane.driven_offset_m, 3)
    if held:
        properties["held"] = True
    lines = {"centerline": lane.centerline_m, "left": lane.left_m, "right": lane.right_m}
    edges = {"left": lane.left_edge, "right": lane.right_edge}
    for (role, line_m), shift_m in zip(lines.items(), lane.shift_sigma_m, strict=True):
        own = _edge_properties(edges.get(role))
        if np.isfinite(shift_m):
            own = {"shift_sigma_m": _rounded(shift_m, 3)} | own
        yield {
            "type": "Feature",
            "id": f"lane-{lane.lane_id}-{role}",
            "properties": {"lane_id": lane.lane_id, "role": role, **properties, **own},
            "geometry": {"type": "LineString", "coordinates": _coordinates(line_m, datum)},
        }


def _edge_properties(edge: LaneEdge | None) -> dict[str, Any]:
    """What a boundary was taken from, where that is known."""
    if edge is None:
        return {}
    about: dict[str, Any] = {
        "boundary_source": edge.source,
        "boundary_sigma_m": _rounded(edge.sigma_m, 3),
    }
    if edge.source == "traffic":
        return about
    if edge.sigma_along_m:
        about["boundary_sigma_along_m"] = [_rounded(value, 3) for value in edge.sigma_along_m]
    return about | {
        "marking": edge.marking,
        "marking_colour": edge.colour,
        "marking_width_m": _rounded(edge.marking_width_m, 2),
        "painted_share": _rounded(edge.painted_share, 2),
    }


def _coordinates(point_m: NDArray[np.float64], datum: Datum) -> list[list[float]]:
    rounded = np.round(datum.to_geodetic(point_m)[:, ::-1], DECIMALS)
    return [[float(lon), float(lat)] for lon, lat in rounded]


def _polygon(point_m: NDArray[np.float64], datum: Datum) -> dict[str, Any] | None:
    if len(point_m) < 3:
        return None
    x, y = point_m.T
    area = float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))
    ring = _coordinates(point_m if area > 0 else point_m[::-1], datum)  # RFC 7946: exterior CCW
    return {"type": "Polygon", "coordinates": [[*ring, ring[0]]]}


def _rounded(value: float, decimals: int) -> float | None:
    return round(float(value), decimals) if np.isfinite(value) else None


def _compact(value: object) -> str:
    return json.dumps(value, separators=(",", ":"), allow_nan=False, ensure_ascii=False)
