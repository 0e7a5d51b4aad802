"""What a scene file says: roads, traffic, camera, noise. Validated when it is read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field, ValidationError, model_validator

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.core.resources import file_or_shipped, shipped_names
from geoorbit_ros.scenes.camera import scene_lens
from geoorbit_ros.scenes.road_plan import Positive, Road, RoadPoint
from geoorbit_ros.storage.yaml_file import Key, StrictModel, WrongValue, read_yaml

_FOLDER = "params/scenes"

Pixels = Annotated[int, Field(ge=160, le=8192)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]


@dataclass(frozen=True, slots=True)
class VehicleType:
    """A type of vehicle and how a detector calls it.

    Attributes:
        length_m: Mean.
        width_m: Mean.
        height_m: Mean.
        spread: 1-sigma of the sizes, relative.
        coco_class: Class that a detector gives it.
        vclass: SUMO's vClass.
        speed_factor: Wished speed relative to the speed limit.
    """

    length_m: float
    width_m: float
    height_m: float
    spread: float
    coco_class: int
    vclass: str
    speed_factor: float


VEHICLE_TYPES: dict[str, VehicleType] = {
    "car": VehicleType(4.5, 1.82, 1.47, 0.05, 2, "passenger", 1.0),
    "suv": VehicleType(4.8, 1.95, 1.75, 0.05, 2, "passenger", 1.0),
    "van": VehicleType(5.6, 2.0, 2.3, 0.08, 2, "delivery", 0.97),
    "truck": VehicleType(9.0, 2.5, 3.4, 0.08, 7, "truck", 0.88),
    "semitrailer": VehicleType(16.5, 2.55, 4.0, 0.03, 7, "trailer", 0.85),
    "bus": VehicleType(12.0, 2.55, 3.2, 0.04, 5, "bus", 0.9),
    "motorcycle": VehicleType(2.2, 0.8, 1.5, 0.05, 3, "motorcycle", 1.05),
}
"""Sizes: typical in Europe and North America (AASHTO design vehicles P, SU, WB, BUS). Spreads and
speeds chosen."""


class Place(StrictModel):
    """The scene's origin on earth."""

    latitude_deg: float = Field(ge=-85.0, le=85.0)
    longitude_deg: float = Field(ge=-180.0, le=180.0)


class Flow(StrictModel):
    """Traffic along a list of roads.

    Attributes:
        route: Roads in travel order.
        per_hour: Vehicles per hour.
        lane_shares: Share of the flow that enters in each lane, right to left; default even.
        arrival_lane: Lane of the last road that its drivers choose, 0 the rightmost; default any.
    """

    route: list[str] = Field(min_length=1)
    per_hour: Positive
    lane_shares: list[Share] | None = None
    arrival_lane: int | None = Field(default=None, ge=0)


class Traffic(StrictModel):
    """All traffic.

    Attributes:
        flows: Where vehicles come from and go to.
        mix: Share of each vehicle type.
        speed_factor_sigma: Spread of the drivers' wished speeds.
        driver_offset_sigma_m: Spread of their habitual places across the lane.
        wander_sigma_m: 1-sigma of each vehicle's slow wander about its own place.
        edge_shift_m: How far drivers in the outermost and innermost lane of a road keep towards
            the lane beside, in the mean.
        edge_shift_sigma_m: How much that differs from lane to lane.
        lorries_outside: Share of the lorries and buses that enter in the outermost lane; default as
            all vehicles.
        keep_right: How eagerly drivers return to the right lane (SUMO's lcKeepRight).
        early_lane_change: How early they change for their route (SUMO's lcStrategic).
    """

    flows: list[Flow] = Field(min_length=1)
    mix: dict[str, Share] = Field(default={"car": 0.62, "suv": 0.22, "van": 0.07, "truck": 0.09})
    speed_factor_sigma: float = Field(default=0.1, ge=0.0, le=0.5)
    driver_offset_sigma_m: float = Field(default=0.2, ge=0.0, le=0.8)
    wander_sigma_m: float = Field(default=0.12, ge=0.0, le=0.8)
    edge_shift_m: float = Field(default=0.0, ge=-0.8, le=0.8)
    edge_shift_sigma_m: float = Field(default=0.0, ge=0.0, le=0.4)
    lorries_outside: Share | None = None
    keep_right: float = Field(default=0.0, ge=0.0, le=10.0)
    early_lane_change: float = Field(default=1.0, ge=0.0, le=10.0)

    @model_validator(mode="after")
    def _known_types(self) -> Traffic:
        for name in self.mix:
            if name not in VEHICLE_TYPES:
                known = ", ".join(VEHICLE_TYPES)
                raise WrongValue(("mix", name), "an unknown type", f"one of {known}")
        return self


class Camera(StrictModel):
    """A camera on a pole.

    Attributes:
        pole: Where it stands.
        height_m: Above the road.
        look_at: Point on the ground in the image's middle.
        horizontal_fov_deg: Field of view without distortion: it says the focal length.
        image_size: Width and height in pixels.
        fps: Frames per second.
        k1: First radial coefficient of the lens (plumb_bob): negative for a barrel.
        k2: Second one.
        lens_known: Whether the control points' file says the lens.
    """

    pole: RoadPoint
    height_m: float = Field(ge=3.0, le=60.0)
    look_at: RoadPoint
    horizontal_fov_deg: float = Field(default=60.0, ge=5.0, le=120.0)
    image_size: tuple[Pixels, Pixels] = (1920, 1080)
    fps: float = Field(default=15.0, ge=1.0, le=60.0)
    k1: float = Field(default=0.0, ge=-0.6, le=0.4)
    k2: float = Field(default=0.0, ge=-0.2, le=0.5)
    lens_known: bool = True

    @model_validator(mode="after")
    def _shown_by_the_lens(self) -> Camera:
        if self.k1 or self.k2:
            width, height = self.image_size
            lens = scene_lens(self.horizontal_fov_deg, self.image_size, self.k1, self.k2)
            corners = np.array([[x, y] for x in (0, width / 2, width) for y in (0, height)])
            if not np.isfinite(lens.undistort(corners)).all():
                expected = "a smaller field of view, or a larger k2: the image's corners fold over"
                raise WrongValue(("k1",), f"{self.k1:g} with k2 = {self.k2:g}", expected)
        return self


class DetectorFaults(StrictModel):
    """Faults of the imagined detector and tracker.

    Attributes:
        edge_noise_px: 1-sigma of each box edge, independent from frame to frame.
        edge_noise_share: The same as a share of the box's size, slowly varying.
        miss_rate: Share of boxes lost at random; small boxes are lost more often.
        min_height_px: Smaller boxes are not detected.
        occluded_share: A box covered more than this by nearer ones is lost.
        id_switch_per_minute: Times that two neighbouring tracks swap their ids.
        class_error: Share of frames with the wrong class.
        false_tracks: Boxes that jitter on the spot through the whole recording.
        time_jitter_s: 1-sigma of the frame times.
    """

    edge_noise_px: float = Field(default=0.8, ge=0.0)
    edge_noise_share: float = Field(default=0.02, ge=0.0, le=0.3)
    miss_rate: Share = 0.03
    min_height_px: float = Field(default=12.0, ge=0.0)
    occluded_share: Share = 0.7
    id_switch_per_minute: float = Field(default=4.0, ge=0.0)
    class_error: Share = 0.02
    false_tracks: int = Field(default=1, ge=0)
    time_jitter_s: float = Field(default=0.002, ge=0.0)


class Scene(StrictModel):
    """A synthetic roadside camera and the road it watches."""

    name: str = Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")
    description: str
    place: Place
    lane_width_m: float = Field(default=3.6, ge=2.5, le=5.0)
    roads: list[Road] = Field(min_length=1)
    traffic: Traffic
    camera: Camera
    detector: DetectorFaults = DetectorFaults()

    @model_validator(mode="after")
    def _consistent(self) -> Scene:
        check_scene(self)
        return self


MEASURED_DRIVERS = {
    "driver_offset_sigma_m": 0.35,
    "edge_shift_m": 0.24,
    "edge_shift_sigma_m": 0.15,
    "lorries_outside": 0.85,
}
"""Habits of drivers at fifteen motorway cameras with surveyed lines; at the six middle cameras of
BrnoCompSpeed (Sochor et al. 2017, arXiv:1702.06441) the median driver of 13 edge lanes keeps 0.22 m
towards the lane beside (0.22 m from lane to lane), and drivers differ by 0.37 m, both with the
error of the tracks. The share of lorries is chosen: German and Czech motorways keep most to the
right."""


def with_measured_drivers(scene: Scene) -> Scene:
    """The scene with the habits of real drivers, which are not in the middle of their lanes."""
    return scene.model_copy(update={"traffic": scene.traffic.model_copy(update=MEASURED_DRIVERS)})


def with_camera(scene: Scene, change: dict[str, float | bool], place: str) -> Scene:
    """The scene with other values of its camera.

    Raises:
        ParameterError: A value that a camera can't have, or values that contradict each other.
    """
    values = scene.camera.model_dump() | change
    try:
        camera = Camera.model_validate(values)
    except (ValidationError, WrongValue) as error:
        named = ", ".join(f"{key}={value:g}" for key, value in change.items())
        expected = "a lens and a field of view that a scene's camera can have"
        found = error.errors() if isinstance(error, ValidationError) else []
        if found and found[0]["loc"]:
            expected = f"{found[0]['loc'][0]}: {found[0]['msg']}"
        raise ParameterError(place, named, expected) from None
    return scene.model_copy(update={"camera": camera})


def shipped_scenes() -> list[str]:
    """Names of the scenes that come with the package."""
    return shipped_names(_FOLDER)


def load_scene(path: str | Path) -> Scene:
    """Read a scene file, or a shipped scene by its bare name.

    Raises:
        InputFileError: No such file, or a value that a scene can't have, with its line and key.
    """
    return read_yaml(file_or_shipped(path, _FOLDER, "scene"), Scene, "scene")


def check_scene(scene: Scene) -> None:
    """Raise `WrongValue` for the first contradiction."""
    roads: dict[str, Road] = {}
    for k, road in enumerate(scene.roads):
        if road.id in roads:
            raise WrongValue(("roads", k, "id"), f"'{road.id}' again", "an id of its own")
        roads[road.id] = road
    for k, road in enumerate(scene.roads):
        _check_anchor(("roads", k), road, roads)
    for k, road in enumerate(scene.roads):
        _check_circle(("roads", k), road, roads)
        _check_bends(("roads", k), road, scene)
    if sum(scene.traffic.mix.values()) <= 0.0:
        raise WrongValue(("traffic", "mix"), "no share above 0", "shares of vehicle types")
    for k, flow in enumerate(scene.traffic.flows):
        _check_flow(("traffic", "flows", k), flow, roads)
    for name in ("pole", "look_at"):
        _check_point(("camera", name), getattr(scene.camera, name), roads)
    if scene.camera.pole == scene.camera.look_at:
        raise WrongValue(("camera", "look_at"), "the place of the pole", "a point beside it")


def road_length_m(road: Road, roads: dict[str, Road]) -> float:
    """Length of a road's left border."""
    source, median = (
        (roads[road.opposite.road], road.opposite.median_m) if road.opposite else (road, 0.0)
    )
    return sum(piece.length_m(median) for piece in source.path)


def _known(key: Key, name: str, roads: dict[str, Road]) -> Road:
    if name not in roads:
        raise WrongValue(key, f"'{name}'", f"one of the roads {', '.join(roads)}")
    return roads[name]


def _check_anchor(key: Key, road: Road, roads: dict[str, Road]) -> None:
    if road.follows:
        _known((*key, "follows"), road.follows, roads)
    if road.opposite:
        other = _known((*key, "opposite", "road"), road.opposite.road, roads)
        if other.opposite:
            raise WrongValue(
                (*key, "opposite", "road"),
                f"'{other.id}', itself an opposite",
                "a road with a path",
            )
    for name in ("leaves", "joins"):
        ref = getattr(road, name)
        if ref is None:
            continue
        lanes = _known((*key, name, "road"), ref.road, roads).lanes
        if ref.lane + road.lanes > lanes:
            wanted = f"lane 0 to {lanes - road.lanes} of '{ref.road}', which has {lanes}"
            beside = "" if road.lanes == 1 else f", with {road.lanes} lanes side by side"
            expected = wanted + beside if road.lanes <= lanes else f"a road of {road.lanes} lanes"
            raise WrongValue((*key, name, "lane"), ref.lane, expected)


def _check_circle(key: Key, road: Road, roads: dict[str, Road]) -> None:
    chain = [road.id]
    while (anchor := roads[chain[-1]].anchor) is not None:
        if anchor in chain:
            circle = " → ".join([*chain[chain.index(anchor) :], anchor])
            raise WrongValue(key, f"roads in a circle: {circle}", "a road with 'start' among them")
        chain.append(anchor)


def _check_bends(key: Key, road: Road, scene: Scene) -> None:
    """No lane folds over: a bend's centre is outside of the road and its other carriageway."""
    default = scene.lane_width_m
    right = road.lanes * (road.lane_width_m or default)
    left = max(
        (
            other.opposite.median_m + other.lanes * (other.lane_width_m or default)
            for other in scene.roads
            if other.opposite and other.opposite.road == road.id
        ),
        default=0.0,
    )
    for k, piece in enumerate(road.path):
        inside = left if piece.turn_deg > 0 else right
        if piece.radius_m <= inside:
            raise WrongValue(
                (*key, "path", k, "radius_m"),
                f"{piece.radius_m:g}",
                f"more than the {inside:g} m of road inside the bend",
            )


def _check_flow(key: Key, flow: Flow, roads: dict[str, Road]) -> None:
    for k, name in enumerate(flow.route):
        road = _known((*key, "route", k), name, roads)
        if k == 0:
            continue
        before = roads[flow.route[k - 1]]
        leaves = road.leaves is not None and road.leaves.road == before.id
        joins = before.joins is not None and before.joins.road == name
        if not (road.follows == before.id or leaves or joins):
            raise WrongValue(
                (*key, "route", k), f"'{name}'", f"a road that begins where '{before.id}' ends"
            )
    first, last = roads[flow.route[0]], roads[flow.route[-1]]
    shares = flow.lane_shares
    if shares is not None and (len(shares) != first.lanes or sum(shares) <= 0.0):
        raise WrongValue(
            (*key, "lane_shares"),
            shares,
            f"{first.lanes} shares, one per lane of '{first.id}', not all 0",
        )
    if flow.arrival_lane is not None and flow.arrival_lane >= last.lanes:
        raise WrongValue(
            (*key, "arrival_lane"), flow.arrival_lane, f"0 to {last.lanes - 1} on '{last.id}'"
        )


def _check_point(key: Key, point: RoadPoint, roads: dict[str, Road]) -> None:
    length = road_length_m(_known((*key, "road"), point.road, roads), roads)
    if point.along_m > length:
        raise WrongValue(
            (*key, "along_m"), f"{point.along_m:g}", f"0 to {length:.1f}, the end of '{point.road}'"
        )
