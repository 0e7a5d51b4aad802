"""Roads and tracks for tests of the twin: made, and known exactly."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.tables import TRACK_DTYPE
from geoorbit_ros.scenes.network import write_network
from geoorbit_ros.scenes.road_plan import Bend, LaneRef, Opposite, Road, Start, Straight
from geoorbit_ros.scenes.roads import PlacedRoad, place_roads
from geoorbit_ros.scenes.scene import load_scene
from geoorbit_ros.twin.placement import TwinStep
from geoorbit_ros.twin.scenario import Scenario
from geoorbit_ros.twin.simulation import Moves, States

DATUM = Datum(43.05, -89.35)
STEP_NS = 100_000_000
START_NS = 1_000_000_000


def made_roads() -> dict[str, PlacedRoad]:
    """Three lanes east, 300 m straight and 200 m of bend; two back west; an off-ramp to the right.

    `east` (lanes 0 to 2) leads into `bend`; its lane 0 also into `ramp`. Lane 2 of `east` lies
    along y = -1.75.
    """
    straight, bend = Straight(straight_m=300.0), Bend(radius_m=250.0, turn_deg=45.0)
    roads = [
        Road(id="east", lanes=3, path=[straight], start=Start(x_m=0, y_m=0, heading_deg=90)),
        Road(id="bend", lanes=3, path=[bend], follows="east"),
        Road(
            id="ramp",
            lanes=1,
            path=[Bend(radius_m=200.0, turn_deg=-30.0)],
            leaves=LaneRef(road="east", lane=0),
        ),
        Road(id="west", lanes=2, opposite=Opposite(road="east", median_m=4.0)),
    ]
    scene = load_scene("straight_3x3")
    return place_roads(scene.model_copy(update={"roads": roads, "lane_width_m": 3.5}))


def made_network(folder: Path) -> Path:
    """The roads as a network that knows where on earth it is."""
    return write_network(made_roads(), folder, DATUM)


def rows(
    vehicles: Sequence[tuple[int, float, float]],
    speed_mps: float = 20.0,
    heading_rad: float = 0.0,
    sigma_m: float = 0.3,
    class_id: int = 2,
) -> NDArray[np.void]:
    """`TRACK_DTYPE` of (track id, x, y)."""
    table = np.zeros(len(vehicles), TRACK_DTYPE)
    for k, (track, x, y) in enumerate(vehicles):
        table["track_id"][k], table["x"][k], table["y"][k] = track, x, y
    table["vx"], table["vy"] = speed_mps * np.cos(heading_rad), speed_mps * np.sin(heading_rad)
    table["heading"], table["sigma"], table["score"] = heading_rad, sigma_m, 1.0
    table["length"], table["width"], table["class_id"] = 4.6, 1.8, class_id
    return table


class FakeSimulation:
    """A simulation that has every vehicle where it was put, and remembers who came and went."""

    def __init__(self) -> None:
        self.there: dict[str, tuple[float, float, float]] = {}
        self.entered: list[str] = []
        self.left: list[str] = []
        self.kinds: dict[str, str] = {}
        self.dead: Exception | None = None

    def add(self, name: str, type_name: str, length_m: float, width_m: float) -> None:
        assert name not in self.there
        self.entered.append(name)
        self.kinds[name] = type_name
        self.there[name] = (np.nan, np.nan, np.nan)

    def resize(self, name: str, type_name: str, length_m: float, width_m: float) -> None:
        self.kinds[name] = type_name

    def remove(self, name: str) -> None:
        del self.there[name]
        self.left.append(name)

    def move(self, moves: Moves) -> None:
        if self.dead is not None:
            raise self.dead
        for name, (x, y), angle in zip(moves.name, moves.xy, moves.angle_deg, strict=True):
            assert name in self.there
            self.there[name] = (x, y, angle)

    def step(self) -> None:
        pass

    def states(self, names: Sequence[str]) -> States:
        table = np.array([self.there[name] for name in names]).reshape(-1, 3)
        return States(table[:, :2], table[:, 2], [""] * len(names))

    def set_scenario(self, scenario: Scenario) -> None:
        self.scenario = scenario

    def close(self) -> None:
        self.there.clear()


class Steps(list[TwinStep]):
    """Steps as they came."""

    def of(self, vehicle: int) -> NDArray[np.float64]:
        """(T, 2) places of one vehicle."""
        return np.array([s.xy[s.vehicle_id == vehicle][0] for s in self if vehicle in s.vehicle_id])

    @property
    def vehicles(self) -> set[int]:
        """All that ever were."""
        return {int(v) for step in self for v in step.vehicle_id}
