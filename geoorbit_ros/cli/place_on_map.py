"""Lays a camera that was calibrated from its traffic on a map: `geoorbit calibrate --map`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from geoorbit_ros.core.errors import ParameterError, RoadNetworkError

if TYPE_CHECKING:
    from geoorbit_ros.calibration.control_points import ControlPoints
    from geoorbit_ros.calibration.datum import Datum
    from geoorbit_ros.core.tables import Frames
    from geoorbit_ros.mapcheck.placement import Place, Placement
    from geoorbit_ros.roadnet.network import RoadNetwork

NEAR_SIGMA_M = 50.0
"""1-sigma of a place that was read off a map without looking for the pole."""
COMPASS = ("N", "NE", "E", "SE", "S", "SW", "W", "NW")
SHOWN_PLACES = 4
"""So many of the places that fit are named."""
POLE_SIGMA_M = 2.0
"""How exactly a pole's place is read off an aerial image: a place given no better can be."""
FAR_SIGMAS = 2.0
"""A camera that comes out further from the given place than this, in its 1-sigma, is doubted.
Chosen: chance puts one of eight there; the search ends at `placement_fit.SEARCH_SIGMAS`."""

FARTHEST_M = 5000.0
"""A map whose nearest lane is farther away is of another place. Chosen: no camera sees so far; less
refuses a place that is known to a kilometre."""


@dataclass(frozen=True, slots=True)
class Whereabouts:
    """What a person says about where a camera is.

    Attributes:
        network: The map, with its origin at `near`.
        near: Where the camera stands, roughly.
        near_sigma_m: 1-sigma of that.
        looks_deg: Where it looks, clockwise from north, within some 30 degrees; None: not said.
    """

    network: RoadNetwork
    near: Datum
    near_sigma_m: float
    looks_deg: float | None


def parse_compass(text: str | None) -> float | None:
    """Degrees clockwise from north of `NE` or `45`.

    Raises:
        ParameterError: Neither.
    """
    if text is None:
        return None
    if text.upper() in COMPASS:
        return 45.0 * COMPASS.index(text.upper())
    try:
        degrees = float(text)
    except ValueError:
        degrees = float("nan")
    if not -360.0 <= degrees <= 360.0:
        expected = f"{', '.join(COMPASS)}, or degrees clockwise from north"
        raise ParameterError("option --looks", f"'{text}'", expected)
    return degrees % 360.0


def whereabouts(
    road_map: Path | None,
    near: Datum | None,
    near_sigma_m: float | None,
    looks: str | None,
    *,
    with_points: bool,
) -> Whereabouts | None:
    """What is said of the place on a map; None without a map.

    Raises:
        ParameterError: Options that need others, or contradict them.
        GeoOrbitError: A map that can't be read, or that is not near.
    """
    looks_deg = parse_compass(looks)
    if road_map is None:
        if looks is not None:
            raise ParameterError("option --looks", looks, "a map, too: --map")
        if near_sigma_m is not None:
            found = f"{near_sigma_m:g}"
            raise ParameterError("option --near-sigma", found, "a map, too: --map")
        return None
    if with_points:
        raise ParameterError("option --map", "--points, too", "one: points say where they are")
    if near is None:
        raise ParameterError("option --map", "no --near", "--near LAT,LON: where the camera is")
    from geoorbit_ros.cli.console import status

    sigma_m = NEAR_SIGMA_M if near_sigma_m is None else near_sigma_m
    with status(f"reading {road_map}"):
        network = _network(road_map, near)
    return Whereabouts(network, near, sigma_m, looks_deg)


def place_on_map(
    points: ControlPoints, frames: Frames, image_size: tuple[int, int], where: Whereabouts
) -> tuple[ControlPoints, list[str]]:
    """Control points with their true places, and what a person must know about it.

    Where several places fit about equally well, the points stay where they are, and the places are
    named.

    Args:
        points: In a frame that begins below the camera, y ahead.
        frames: The traffic.
        image_size: (width, height) in pixels.
        where: The map, and what is known.

    Raises:
        NoTrafficError: Too little traffic for lanes.
        RoadNetworkError: A map that can't be used, or that has no road like this one near.
    """
    import numpy as np

    from geoorbit_ros.calibration.box_projector import BoxProjector
    from geoorbit_ros.calibration.homography import fit_homography
    from geoorbit_ros.lanes.estimators.estimator import make_estimator
    from geoorbit_ros.lanes.mapping.mapper import LaneMapper
    from geoorbit_ros.lanes.pipeline import map_blocks, project_blocks
    from geoorbit_ros.mapcheck.placement import place_lanes
    from geoorbit_ros.mapcheck.placement_fit import RoughPlace

    projector = BoxProjector(fit_homography(points), image_size)
    mapper = LaneMapper(make_estimator("curvilinear"))
    lane_map = map_blocks(project_blocks(frames, projector), mapper)
    rough = RoughPlace(
        near_m=np.zeros(2),  # the network is read with its origin there
        camera_m=np.zeros(2),
        near_sigma_m=where.near_sigma_m,
        scale_sigma=max(points.facts.scale_sigma, 0.01),
        turn_rad=None if where.looks_deg is None else -np.radians(where.looks_deg),
    )
    found = place_lanes(lane_map.lanes, where.network, rough)
    said = [*found.sentences(), *_surer(found, where)]
    if found.ambiguous:
        written = "the file has none of these places: only lanes, widths and speeds are right in it"
        return points, _as_sentences([*said, *_named(found, where.near), written])
    best = found.best
    moved = replace(
        points,
        local_m=best.points(points.local_m),
        datum=where.near,
        sigma_m=None if points.sigma_m is None else best.scale * points.sigma_m,
        facts=replace(
            points.facts,
            north_known=True,
            scale_sigma=min(points.facts.scale_sigma, float(np.sqrt(best.covariance[3, 3]))),
        ),
    )
    return moved, _as_sentences([*said, *_found_at(best, where)])


def _found_at(best: Place, where: Whereabouts) -> list[str]:
    """Where the camera came out, and whether that is where it is said to be."""
    import numpy as np

    looks_deg = (-np.degrees(best.turn_rad)) % 360.0
    here = best.points(np.zeros((1, 2)))
    latitude, longitude = where.near.to_geodetic(here)[0]
    said = [
        f"the camera is at {latitude:.6f},{longitude:.6f}, looking to {looks_deg:.0f}° "
        "(clockwise from north)"
    ]
    away_m = float(np.hypot(*here[0]))
    if away_m > FAR_SIGMAS * where.near_sigma_m:
        said.append(
            f"that is {away_m:.0f} m from --near, which is said to be right to "
            f"± {where.near_sigma_m:g} m: is it this road, and is --looks right"
            "? Don't use the file before you know"
        )
    return said


def _surer(found: Placement, where: Whereabouts) -> list[str]:
    """What a person can still say that makes the place surer."""
    ways = []
    if where.near_sigma_m > POLE_SIGMA_M:
        ways.append(
            "the pole's place from an aerial image (--near, with "
            f"--near-sigma {POLE_SIGMA_M:g} if it is right to {POLE_SIGMA_M:g} m)"
        )
    if where.looks_deg is None:
        ways.append("the direction in which the camera looks (--looks)")
    ways.append("two points that you know, in place of the map (--points)")
    return [] if found.sure else ["surer with: " + "; ".join(ways)]


def _as_sentences(texts: list[str]) -> list[str]:
    return [f"{text[0].upper()}{text[1:]}." for text in texts]


def _network(road_map: Path, near: Datum) -> RoadNetwork:
    import numpy as np

    from geoorbit_ros.roadnet.map_build import build_from_osm
    from geoorbit_ros.roadnet.network import load_network
    from geoorbit_ros.roadnet.network_file import is_network

    if is_network(road_map):
        network = load_network(road_map, near)
    else:
        with TemporaryDirectory() as folder:
            network = build_from_osm(road_map, Path(folder), near).network
    away_m = float(np.hypot(*network.point_m.T).min(initial=np.inf))
    if away_m > FARTHEST_M:
        raise RoadNetworkError(
            str(road_map),
            f"no lane near the given place, the nearest is {away_m / 1000:.0f} km away",
            "a map of the place that --near LATITUDE,LONGITUDE names",
        )
    return replace(network, path=road_map)


def _named(found: Placement, datum: Datum) -> list[str]:
    """The places that fit, for people to choose from."""
    import numpy as np

    places = found.places[:SHOWN_PLACES]
    spots = np.array([place.points(np.zeros((1, 2)))[0] for place in places])
    return [
        f"  {100 * place.share:.0f} %: the camera at {latitude:.6f},{longitude:.6f}, looking to "
        f"{(-np.degrees(place.turn_rad)) % 360.0:.0f}°"
        for place, (latitude, longitude) in zip(places, datum.to_geodetic(spots), strict=True)
    ]
