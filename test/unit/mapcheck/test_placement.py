"""Lanes whose frame has no place are laid on a network, and it is said how sure that is."""

from dataclasses import replace

import numpy as np
import pytest
from made_detections import detected
from made_twin import made_network
from numpy.typing import NDArray

from geoorbit_ros.core.errors import NoTrafficError, RoadNetworkError
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.mapcheck.placement import Placement, place_lanes
from geoorbit_ros.mapcheck.placement_fit import RoughPlace
from geoorbit_ros.roadnet.network import RoadNetwork, load_network

TURN_RAD, SCALE = 2.2, 1.02
POLE_M = np.array([300.0, 20.0])
HERE = np.zeros(2)


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> RoadNetwork:
    return load_network(made_network(tmp_path_factory.mktemp("net")))


def unplaced(lines: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points of the network in a frame with the pole at (0, 0), turned and of another scale."""
    cos, sin = np.cos(TURN_RAD), np.sin(TURN_RAD)
    return np.asarray((lines - POLE_M) @ np.array([[cos, sin], [-sin, cos]]) * SCALE)


def seen(network: RoadNetwork, low_m: float, high_m: float) -> tuple[list[Lane], list[Lane]]:
    """Lanes between two eastings, where they are and as a camera without a place has them."""
    true, own = [], []
    for each in detected(network):
        x = each.centerline_m[:, 0]
        line = each.centerline_m[(x >= low_m) & (x <= high_m)]
        if len(line) > 5:
            true.append(replace(each, centerline_m=line))
            own.append(replace(each, centerline_m=unplaced(line)))
    return true, own


def furthest_m(found: Placement, true: list[Lane], own: list[Lane]) -> float:
    """Largest distance of the placed lanes from where they are."""
    return max(
        float(np.hypot(*(found.best.points(b.centerline_m) - a.centerline_m).T).max())
        for a, b in zip(true, own, strict=True)
    )


def test_lanes_with_a_bend_find_their_place_from_any_direction(network: RoadNetwork) -> None:
    true, own = seen(network, 200.0, 430.0)
    found = place_lanes(own, network, RoughPlace(POLE_M + 20.0, HERE, 25.0))
    assert found.sure
    assert furthest_m(found, true, own) < 1.0
    assert found.best.scale == pytest.approx(1.0 / SCALE, abs=0.01)
    back = found.best.inverse_points(found.best.points(own[0].centerline_m))
    assert np.abs(back - own[0].centerline_m).max() < 1e-9


def test_on_a_straight_road_the_place_along_it_is_not_sure(network: RoadNetwork) -> None:
    true, own = seen(network, 80.0, 220.0)
    found = place_lanes(own, network, RoughPlace(POLE_M + 12.0, HERE, turn_rad=-TURN_RAD))
    assert not found.sure
    assert found.along_sigma_m > 5.0
    assert "how far along the road" in found.sentences()[0]
    away = found.best.points(own[0].centerline_m) - true[0].centerline_m
    assert np.abs(away @ [-found.along[1], found.along[0]]).max() < 0.3


def test_the_place_of_the_pole_makes_it_sure(network: RoadNetwork) -> None:
    true, own = seen(network, 230.0, 290.0)
    rough = place_lanes(own, network, RoughPlace(POLE_M, HERE, turn_rad=-TURN_RAD))
    exact = place_lanes(own, network, RoughPlace(POLE_M, HERE, 0.3, 0.02, -TURN_RAD))
    assert exact.along_sigma_m < 0.5 * rough.along_sigma_m
    assert furthest_m(exact, true, own) < 1.5


def test_a_road_that_looks_the_same_from_its_other_end_has_two_places(
    network: RoadNetwork,
) -> None:
    """Two lanes there and two back: only the direction of view tells the ends apart."""
    line = np.column_stack((np.linspace(-60.0, 60.0, 61), np.zeros(61)))
    base = detected(network)[0]
    own = [
        replace(base, centerline_m=(line if y < 0 else line[::-1]) + [0.0, y])
        for y in (-5.25, -1.75, 1.75, 5.25)
    ]
    both = straight_both_ways(network, own)
    found = place_lanes(own, both, RoughPlace(HERE, HERE, 25.0))
    assert len(found.places) > 1
    turns = sorted(abs(place.turn_rad) for place in found.places)
    assert turns[0] < 0.1
    assert turns[-1] > np.pi - 0.1
    assert any("places fit" in sentence for sentence in found.sentences())
    told = place_lanes(own, both, RoughPlace(HERE, HERE, 25.0, turn_rad=0.3))
    assert all(abs(place.turn_rad) < 0.1 for place in told.places)


def straight_both_ways(network: RoadNetwork, lanes: list[Lane]) -> RoadNetwork:
    """A network of these lanes, each 200 m longer at both ends."""
    lines = []
    for lane in lanes:
        first, last = lane.centerline_m[0], lane.centerline_m[-1]
        ahead = (last - first) / np.hypot(*(last - first))
        lines.append(np.array([first - 200.0 * ahead, last + 200.0 * ahead]))
    count = len(lines)
    return replace(
        network,
        lane_id=tuple(f"lane_{k}" for k in range(count)),
        edge_id=("there", "there", "back", "back"),
        index=np.array([0, 1, 1, 0]),
        internal=np.zeros(count, np.bool_),
        width_m=np.full(count, 3.5),
        speed_mps=np.full(count, 30.0),
        length_m=np.full(count, 520.0),
        left=np.full(count, -1),
        right=np.full(count, -1),
        start=np.arange(count + 1) * 2,
        point_m=np.concatenate(lines),
        successors=((),) * count,
        turnarounds=((),) * count,
        allowed=(frozenset({"passenger"}),) * count,
        both_ways=np.zeros(count, np.bool_),
    )


def test_what_cannot_be_placed_is_told(network: RoadNetwork) -> None:
    _, own = seen(network, 200.0, 430.0)
    with pytest.raises(RoadNetworkError, match="the nearest is"):
        place_lanes(own, network, RoughPlace(np.array([9000.0, 0.0]), HERE))
    with pytest.raises(NoTrafficError, match="none confirmed"):
        place_lanes([replace(own[0], status="tentative")], network, RoughPlace(POLE_M, HERE))
