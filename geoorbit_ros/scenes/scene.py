"""What a scene file says: roads, traffic, camera, noise. Validated when it is read."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.resources import share_path
from geoorbit_ros.scenes.vehicles import VEHICLE_TYPES

Positive = Annotated[float, Field(gt=0.0)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Place(_Strict):
    """The scene's origin on earth."""

    latitude_deg: float = Field(ge=-85.0, le=85.0)
    longitude_deg: float = Field(ge=-180.0, le=180.0)


class Straight(_Strict):
    """A straight piece of road."""

    straight_m: Positive


class Bend(_Strict):
    """An arc; positive `turn_deg` bends to the left."""

    radius_m: Positive
    turn_deg: float = Field(ge=-270.0, le=270.0)


class Start(_Strict):
    """Where a road's left border begins, and its heading clockwise from north."""

    x_m: float
    y_m: float
    heading_deg: float


class LaneRef(_Strict):
    """One lane of a road; lane 0 is the rightmost."""

    road: str
    lane: int = Field(ge=0)


class Opposite(_Strict):
    """Beside another road, in the other direction, `median_m` between the left borders."""

    road: str
    median_m: float = Field(ge=0.0)


class Road(_Strict):
    """A one-way road.

    Exactly one of `start`, `follows`, `leaves`, `joins` and `opposite` says where it lies.

    Attributes:
        id: Its name.
        lanes: Number of lanes.
        path: Pieces in travel order, along the left border.
        speed_kmh: Speed limit.
        start: Its left border begins here.
        follows: It begins where that road ends, left borders aligned.
        leaves: It begins at the end of that lane (an off-ramp).
        joins: It ends at the beginning of that lane (an on-ramp).
        opposite: It is the other carriageway of that road, and takes its shape from it.
        lane_width_m: Overrides the scene's.
    """

    id: str = Field(pattern=r"^[a-z][a-z0-9_]*$")
    lanes: int = Field(ge=1, le=8)
    path: list[Straight | Bend] = []
    speed_kmh: Positive = 100.0
    start: Start | None = None
    follows: str | None = None
    leaves: LaneRef | None = None
    joins: LaneRef | None = None
    opposite: Opposite | None = None
    lane_width_m: float | None = Field(default=None, ge=2.5, le=5.0)

    @model_validator(mode="after")
    def _one_place(self) -> Road:
        places = ("start", "follows", "leaves", "joins", "opposite")
        given = [name for name in places if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(
                f"road '{self.id}' has {given or 'no place'}, expected exactly one of {places}"
            )
        if bool(self.path) == bool(self.opposite):
            raise ValueError(
                f"road '{self.id}' has {len(self.path)} path pieces, "
                "expected none with 'opposite', at least one otherwise"
            )
        return self

    @property
    def anchor(self) -> str | None:
        """The road that this one's place depends on."""
        ref = self.leaves or self.joins or self.opposite
        return ref.road if ref else self.follows


class Flow(_Strict):
    """Traffic along a list of roads.

    Attributes:
        route: Roads in travel order.
        per_hour: Vehicles per hour.
        lane_shares: Share of the flow that enters in each lane, right to left; default even.
    """

    route: list[str] = Field(min_length=1)
    per_hour: Positive
    lane_shares: list[Share] | None = None


class Traffic(_Strict):
    """All traffic.

    Attributes:
        flows: Where vehicles come from and go to.
        mix: Share of each vehicle type.
        speed_factor_sigma: Spread of the drivers' wished speeds.
        driver_offset_sigma_m: Spread of their habitual places across the lane.
        wander_sigma_m: 1-sigma of each vehicle's slow wander about its own place.
        keep_right: How eagerly drivers return to the right lane (SUMO's lcKeepRight).
        early_lane_change: How early they change for their route (SUMO's lcStrategic).
    """

    flows: list[Flow] = Field(min_length=1)
    mix: dict[str, Share] = Field(default={"car": 0.62, "suv": 0.22, "van": 0.07, "truck": 0.09})
    speed_factor_sigma: float = Field(default=0.1, ge=0.0, le=0.5)
    driver_offset_sigma_m: float = Field(default=0.2, ge=0.0, le=0.8)
    wander_sigma_m: float = Field(default=0.12, ge=0.0, le=0.8)
    keep_right: float = Field(default=0.0, ge=0.0, le=10.0)
    early_lane_change: float = Field(default=1.0, ge=0.0, le=10.0)

    @model_validator(mode="after")
    def _known_types(self) -> Traffic:
        unknown = sorted(set(self.mix) - set(VEHICLE_TYPES))
        if unknown:
            raise ValueError(f"mix has {unknown}, expected types of {sorted(VEHICLE_TYPES)}")
        return self


class RoadPoint(_Strict):
    """A point seen from a road: metres along its left border, and to the right of it."""

    road: str
    along_m: float = Field(ge=0.0)
    right_m: float = 0.0


class Camera(_Strict):
    """A camera on a pole.

    Attributes:
        pole: Where it stands.
        height_m: Above the road.
        look_at: Point on the ground in the image's middle.
        horizontal_fov_deg: Field of view.
        image_size: Width and height in pixels.
        fps: Frames per second.
    """

    pole: RoadPoint
    height_m: float = Field(ge=3.0, le=60.0)
    look_at: RoadPoint
    horizontal_fov_deg: float = Field(default=60.0, ge=5.0, le=120.0)
    image_size: tuple[int, int] = (1920, 1080)
    fps: float = Field(default=15.0, ge=1.0, le=60.0)


class Detector(_Strict):
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


class Scene(_Strict):
    """A synthetic roadside camera and the road it watches."""

    name: str
    description: str
    place: Place
    lane_width_m: float = Field(default=3.6, ge=2.5, le=5.0)
    roads: list[Road] = Field(min_length=1)
    traffic: Traffic
    camera: Camera
    detector: Detector = Detector()
    driving_side: Literal["right"] = "right"

    @model_validator(mode="after")
    def _known_roads(self) -> Scene:
        known: set[str] = {road.id for road in self.roads}
        if len(known) != len(self.roads):
            raise ValueError("roads: two have the same id, expected distinct ids")
        for road in self.roads:
            if road.anchor and road.anchor not in known:
                raise ValueError(
                    f"road '{road.id}' refers to '{road.anchor}', expected one of {sorted(known)}"
                )
        named = [name for flow in self.traffic.flows for name in flow.route]
        for name in [*named, self.camera.pole.road, self.camera.look_at.road]:
            if name not in known:
                raise ValueError(f"no road '{name}', expected one of {sorted(known)}")
        return self


def load_scene(path: str | Path) -> Scene:
    """Read a scene file, or a shipped scene by its bare name.

    Raises:
        InputFileError: No such file, or a value that a scene can't have, named by its key.
    """
    file = Path(path)
    if not file.suffix:
        file = share_path(f"params/scenes/{path}.yaml")
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputFileError(str(path), f"unreadable ({error})", "a scene file in YAML") from error
    try:
        return Scene.model_validate(yaml.safe_load(text))
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = f"{file}, line {mark.line + 1}" if mark else str(file)
        raise InputFileError(place, "broken YAML", "a scene file in YAML") from error
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"]) or "the scene"
        raise InputFileError(
            f"{file}, key '{key}'", repr(first["input"])[:80], first["msg"]
        ) from error
