"""Reading lane files that anyone may have written.

One policy for all readers (`core.input_report`): what one feature says is repaired, used or left
out, counted and told; a file is refused when most of it is bad.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.bounded_json import read_json
from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.input_report import InputReport, Treatment
from geoorbit_ros.core.lanes import (
    CrossSection,
    Lane,
    LaneEdge,
    LaneMap,
    Marking,
    MarkingColour,
    Status,
    ViewNote,
)
from geoorbit_ros.core.polylines import offset_line, project
from geoorbit_ros.lanes.geojson_tidying import Tidying, is_number

EXPECTED = "a GeoJSON file of lanes"
ROLES = ("centerline", "left", "right")
MAX_EXTENT_M = 20_000.0
"""A lane further from the datum than this is in the wrong place: no camera sees 20 km."""
MAX_WHY_TEXT = 300
"""Characters of a sentence about the view; longer ones are cut."""
MAX_LANE_ID = 2**31 - 1
"""Ids of lanes are 32 bits wide in messages."""
MAX_FILE_TEXT = 256_000_000
"""Characters of a file. Chosen: lanes of a whole city; what comes in messages is bounded before
(`core.bounded_json`)."""
DRAWN_WIDTH_M = 3.5
"""Distance between boundaries that are made up because a file has only centrelines."""


@dataclass(frozen=True, slots=True)
class Line:
    """One checked feature."""

    place: str
    lane_id: int
    role: str
    lon_lat_deg: NDArray[np.float64]
    properties: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Collection:
    """A checked file: its features and its `geoorbit` member (empty in a third party's file).

    Attributes:
        path: The file.
        lines: Its features that can be used.
        about: Its member `geoorbit`.
        report: What was repaired or left out.
    """

    path: Path
    lines: tuple[Line, ...]
    about: dict[str, Any]
    report: InputReport


def load_collection(path: Path) -> Collection:
    """Parse and check a lane file.

    Raises:
        InputFileError: Unreadable, not JSON, not a FeatureCollection of lane lines.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputFileError(str(path), error.strerror, "a readable file") from error
    except ValueError as error:  # not UTF-8
        raise InputFileError(str(path), error, "a GeoJSON file") from error
    return parse_collection(text, path)


def parse_collection(text: str, path: Path) -> Collection:
    """Parse and check the text of a lane file; `path` is what errors call it.

    Raises:
        InputFileError: Not JSON, not a FeatureCollection of lane lines.
    """
    data = read_json(text, str(path), "a GeoJSON file", InputFileError, MAX_FILE_TEXT)
    if isinstance(data, dict) and data.get("type") == "Feature":
        data = {"type": "FeatureCollection", "features": [data]}
    if not isinstance(data, dict) or data.get("type") != "FeatureCollection":
        found = data.get("type") if isinstance(data, dict) else type(data).__name__
        raise InputFileError(f"{path}, 'type'", repr(found), "'FeatureCollection'")
    features = data.get("features")
    if not isinstance(features, list):
        raise InputFileError(f"{path}, 'features'", repr(features), "a list of features")
    about = data.get("geoorbit", {})
    if not isinstance(about, dict):
        raise InputFileError(f"{path}, 'geoorbit'", repr(about), "an object")
    version = about.get("format", 1)
    if version != 1:
        raise InputFileError(f"{path}, 'geoorbit.format'", version, "format 1")
    report = InputReport(str(path), "features", len(features))
    tidy = Tidying(path, data.get("crs"), about.get("datum"), features)
    lines, faults = [], dict[tuple[str, str], list[str]]()
    for k, feature in enumerate(features):
        try:
            lines.append(_line(path, k, tidy.tidied(k, feature)))
        except InputFileError as error:
            _note(faults, path, error)
    tidy.tell(report)
    _tell(faults, report)
    return Collection(path, tuple(lines), about, report)


def _note(faults: dict[tuple[str, str], list[str]], path: Path, error: InputFileError) -> None:
    """Sort a feature's fault by what it should have been."""
    place = error.place.removeprefix(f"{path}, ")
    key = (place.partition(", ")[2], error.expected)
    faults.setdefault(key, []).append(f"{place}: found {error.found}")


def _tell(faults: dict[tuple[str, str], list[str]], report: InputReport, each: int = 1) -> None:
    for (key, expected), found in faults.items():
        text = f"{key}: expected {expected}" if key else f"expected {expected}"
        report.add(Treatment.LEFT_OUT, each * len(found), text, found[0])


def datum_of(collection: Collection) -> Datum:
    """The file's datum, else the mean of its points.

    Raises:
        InputFileError: A malformed datum, or no datum and no points.
    """
    stated = collection.about.get("datum")
    place = f"{collection.path}, 'geoorbit.datum'"
    if stated is not None:
        try:
            latitude, longitude = float(stated["latitude"]), float(stated["longitude"])
        except (TypeError, KeyError, ValueError) as error:
            raise InputFileError(place, stated, "numbers 'latitude' and 'longitude'") from error
        if not (abs(latitude) <= 90 and abs(longitude) <= 180):
            raise InputFileError(place, stated, "degrees within -90..90 and -180..180")
        return Datum(latitude, longitude)
    if not collection.lines:
        raise InputFileError(str(collection.path), "no features and no datum", "at least one lane")
    longitude, latitude = np.vstack([x.lon_lat_deg for x in collection.lines]).mean(axis=0)
    return Datum(float(latitude), float(longitude))


def lanes_of(collection: Collection, datum: Datum) -> tuple[Lane, ...]:
    """The file's lanes in metres around `datum`, ordered by id.

    Lanes twice, without centreline, without length or far from the datum are left out; the
    collection's report says so.
    """
    by_lane: dict[int, dict[str, Line]] = {}
    faults: dict[tuple[str, str], list[str]] = {}
    for line in collection.lines:
        roles = by_lane.setdefault(line.lane_id, {})
        if line.role in roles:
            found = f"a second {line.role} of lane {line.lane_id}"
            error = InputFileError(line.place, found, "one feature per lane_id and role")
            _note(faults, collection.path, error)
            continue
        roles[line.role] = line
    _tell(faults, collection.report)
    lanes = []
    for lane_id in sorted(by_lane):
        roles = by_lane[lane_id]
        try:
            lanes.append(_lane(collection, lane_id, roles, datum))
        except InputFileError as error:
            faults = {}
            _note(faults, collection.path, error)
            _tell(faults, collection.report, len(roles))
    return tuple(lanes)


def map_of(collection: Collection, datum: Datum, lanes: tuple[Lane, ...]) -> LaneMap:
    """The lane map with what its `geoorbit` member adds: stamp, cross sections, visible range."""
    about = collection.about
    try:
        sections = tuple(
            CrossSection(
                float(section["heading_deg"]),
                np.asarray(section["offset_m"], dtype=np.float64),
                np.asarray(section["density"], dtype=np.float64),
                np.asarray(section["peak_m"], dtype=np.float64),
            )
            for section in about.get("cross_sections", [])
        )
        visible = np.empty((0, 2))
        if about.get("visible"):
            ring = np.asarray(about["visible"]["coordinates"][0], dtype=np.float64)
            visible = datum.to_local(ring[:-1, 1], ring[:-1, 0])
        doubtful = about.get("doubtful") is True
        stamp_ns = about.get("stamp_ns", 0)
        if not (is_number(stamp_ns) and abs(stamp_ns) < 2**63):
            raise ValueError(f"stamp_ns {stamp_ns!r:.40}")
        view = _view_note(about.get("view"))
        return LaneMap(int(stamp_ns), lanes, sections, visible, doubtful=doubtful, view=view)
    except (TypeError, KeyError, ValueError, IndexError, OverflowError) as error:
        place = f"{collection.path}, 'geoorbit'"
        raise InputFileError(place, error, "the members docs/formats.md lists") from error


def _lane(collection: Collection, lane_id: int, roles: dict[str, Line], datum: Datum) -> Lane:
    lines = {role: _local(line, datum) for role, line in roles.items()}
    if "centerline" not in lines and {"left", "right"} <= lines.keys():
        left, right = lines["left"], lines["right"]
        lines["centerline"] = 0.5 * (left + _beside(left, _same_way(left, right)))
        text = "a lane without a centreline has it between its boundaries"
        collection.report.add(Treatment.REPAIRED, 2, text, f"lane {lane_id}")
    if "centerline" not in lines:
        found = f"only {' and '.join(sorted(roles))} of lane {lane_id}"
        expected = "a feature with role 'centerline' for each lane"
        raise InputFileError(str(collection.path), found, expected)
    center = lines["centerline"]
    given = roles["centerline" if "centerline" in roles else "left"].properties
    width = _number(given, "width_m", float("nan"))
    edges = [
        _edge(roles[role].properties, len(center)) if role in roles else None for role in ROLES[1:]
    ]
    sides = []
    for k, (role, sign) in enumerate((("left", 1.0), ("right", -1.0))):
        if role in lines:
            beside = _same_way(center, lines[role])
            if beside is not lines[role] and (edge := edges[k]) is not None:
                edges[k] = replace(edge, sigma_along_m=edge.sigma_along_m[::-1])
            same = len(beside) == len(center)
            sides.append(beside if same else _beside(center, beside))
        else:
            half = 0.5 * (width if np.isfinite(width) else DRAWN_WIDTH_M)
            sides.append(offset_line(center, sign * half))
    both = "left" in lines and "right" in lines
    if both and _on_left(center, sides[1]) > 0.0 > _on_left(center, sides[0]):
        sides.reverse()
        edges.reverse()
        text = "left and right of a lane are exchanged"
        collection.report.add(Treatment.REPAIRED, 2, text, f"lane {lane_id}")
    if not np.isfinite(width) and both:
        width = float(np.mean(np.hypot(*(sides[0] - sides[1]).T)))
    shifts = {
        role: _number(roles[role].properties if role in roles else {}, "shift_sigma_m", np.nan)
        for role in ROLES
    }
    status: Status = given.get("status", "confirmed")
    return Lane(
        lane_id=lane_id,
        centerline_m=center,
        left_m=sides[0],
        right_m=sides[1],
        width_m=width,
        width_sigma_m=_number(given, "width_sigma_m", float("nan")),
        confidence=_number(given, "confidence", 1.0),
        status=status,
        vehicles=_number(given, "vehicles", float("nan")),
        vehicles_missing=int(_number(given, "vehicles_missing", 0.0)),
        sigma_m=_number(given, "sigma_m", float("nan")),
        left_edge=edges[0],
        right_edge=edges[1],
        driven_offset_m=_number(given, "driven_offset_m", float("nan")),
        shift_sigma_m=(shifts["centerline"], shifts["left"], shifts["right"]),
    )


def _edge(properties: dict[str, Any], points: int) -> LaneEdge | None:
    """What a boundary of so many points was taken from, in this program's words."""
    source, sigma_m = properties.get("boundary_source"), properties.get("boundary_sigma_m")
    sigma_m = float(sigma_m) if is_number(sigma_m) else float("nan")
    if source == "traffic":
        return LaneEdge("traffic", sigma_m)
    marking: Any = properties.get("marking")
    colour: Any = properties.get("marking_colour")
    known = marking in get_args(Marking) and colour in get_args(MarkingColour)
    if source != "paint" or not known:
        return None
    share, width_m = properties.get("painted_share"), properties.get("marking_width_m")
    return LaneEdge(
        "paint",
        sigma_m,
        marking,
        colour,
        float(share) if is_number(share) else float("nan"),
        float(width_m) if is_number(width_m) else float("nan"),
        _sigma_along(properties.get("boundary_sigma_along_m"), points),
    )


def _sigma_along(given: object, points: int) -> tuple[float, ...]:
    """The errors at a boundary's points; none where they are not one number for each."""
    if not isinstance(given, list) or len(given) != points or not all(map(is_number, given)):
        return ()
    return tuple(map(float, given))


def _same_way(center: NDArray[np.float64], line: NDArray[np.float64]) -> NDArray[np.float64]:
    """A boundary in the direction of its lane, also when it was drawn the other way."""
    along = float((center[-1] - center[0]) @ (line[-1] - line[0]))
    return line if along >= 0.0 else line[::-1]


def _on_left(center: NDArray[np.float64], line: NDArray[np.float64]) -> float:
    """Median distance of a line to the left of another."""
    return float(np.median(project(line, center).offset_m))


def _beside(center: NDArray[np.float64], line: NDArray[np.float64]) -> NDArray[np.float64]:
    """The points of `line` nearest to each point of `center`."""
    foot = project(center, line)
    arc = np.append(0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T)))
    columns = [np.interp(foot.arc_m, arc, line[:, axis]) for axis in (0, 1)]
    return np.column_stack(columns)


def _local(line: Line, datum: Datum) -> NDArray[np.float64]:
    local = datum.to_local(line.lon_lat_deg[:, 1], line.lon_lat_deg[:, 0])
    far = ~(np.hypot(local[:, 0], local[:, 1]) < MAX_EXTENT_M)
    if far.any():
        k = int(np.argmax(far))
        found = f"point {k} {line.lon_lat_deg[k].tolist()}"
        expected = (
            f"[longitude, latitude] within {MAX_EXTENT_M / 1000:.0f} km of the datum "
            f"({datum.latitude_deg:.5f}, {datum.longitude_deg:.5f})"
        )
        raise InputFileError(line.place, found, expected)
    if np.hypot(*np.diff(local, axis=0).T).sum() < 0.01:
        raise InputFileError(line.place, "a line without length", "two different points")
    return local


def _line(path: Path, k: int, feature: Any) -> Line:
    place = f"{path}, feature {k}"
    if not isinstance(feature, dict):
        raise InputFileError(place, type(feature).__name__, "a GeoJSON Feature")
    properties = feature.get("properties")
    geometry = feature.get("geometry")
    if not isinstance(properties, dict):
        raise InputFileError(f"{place}, 'properties'", repr(properties), "an object")
    if not isinstance(geometry, dict) or geometry.get("type") != "LineString":
        found = geometry.get("type") if isinstance(geometry, dict) else geometry
        raise InputFileError(f"{place}, 'geometry'", repr(found), "a LineString")
    lane_id = properties.get("lane_id")
    if not is_number(lane_id) or lane_id != int(lane_id) or abs(lane_id) > MAX_LANE_ID:
        raise InputFileError(f"{place}, 'lane_id'", repr(lane_id), "a whole number of 32 bits")
    for key, values, default in (
        ("role", ROLES, "centerline"),
        ("status", get_args(Status), "confirmed"),
    ):
        value = properties.get(key, default)
        if value not in values:
            raise InputFileError(f"{place}, '{key}'", repr(value), " or ".join(map(repr, values)))
    role = properties.get("role", "centerline")
    points = _points(place, geometry.get("coordinates"))
    return Line(place, int(lane_id), role, points, properties)


def _points(place: str, coordinates: object) -> NDArray[np.float64]:
    place = f"{place}, 'coordinates'"
    if not isinstance(coordinates, list) or len(coordinates) < 2:
        found = f"{len(coordinates)} points" if isinstance(coordinates, list) else repr(coordinates)
        raise InputFileError(place, found, "at least two points")
    for k, point in enumerate(coordinates):
        pair = point[:2] if isinstance(point, list) else []  # an altitude may follow
        if len(pair) != 2 or not all(map(is_number, pair)):
            expected = "[longitude, latitude] in numbers"
            raise InputFileError(f"{place}, point {k}", repr(point), expected)
        if not (abs(pair[0]) <= 180 and abs(pair[1]) <= 90):
            expected = "longitude within -180..180, then latitude within -90..90"
            raise InputFileError(f"{place}, point {k}", point, expected)
    return np.array([point[:2] for point in coordinates], dtype=np.float64)


def _number(properties: dict[str, Any], key: str, default: float) -> float:
    value = properties.get(key)
    return default if value is None else float(value)


def _view_note(view: object) -> ViewNote | None:
    """What a map says of the view when it was made.

    Raises:
        KeyError, TypeError, ValueError: Not what `docs/formats.md` lists.
    """
    if not view:
        return None
    if not isinstance(view, dict):
        raise TypeError(f"view {view!r:.40}")
    since_ns = view["since_ns"]
    if not (is_number(since_ns) and abs(since_ns) < 2**63):
        raise ValueError(f"since_ns {since_ns!r:.40}")
    return ViewNote(view["held"] is True, int(since_ns), str(view["why"])[:MAX_WHY_TEXT])
