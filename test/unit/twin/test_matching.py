"""Lane matching: the right lane, soon after a change, and no flapping in between."""

from itertools import pairwise

import numpy as np
import pytest
from made_twin import made_network, made_roads
from numpy.typing import NDArray

from geoorbit_ros.roadnet.network import NO_LANE, RoadNetwork, load_network
from geoorbit_ros.twin.matching import LaneMatcher


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> RoadNetwork:
    return load_network(made_network(tmp_path_factory.mktemp("net")))


def drive(
    network: RoadNetwork, line: NDArray[np.float64], noise_m: float = 0.0, turned: bool = True
) -> list[str]:
    """Lanes of one vehicle along (K, 2) places, one per step."""
    matcher = LaneMatcher(network)
    slot = np.array([3])
    matcher.forget(slot)
    random = np.random.default_rng(1)
    heading = np.arctan2(*np.gradient(line, axis=0).T[::-1]) * turned
    lanes = []
    for xy, angle in zip(line, heading, strict=True):
        seen = xy + noise_m * random.standard_normal(2)
        lane = matcher.update(slot, seen[None], np.array([angle]), np.array([0.3])).lane[0]
        lanes.append(network.lane_id[lane] if lane != NO_LANE else "")
    return lanes


def straight(y: float, begin: float = 20.0, end: float = 280.0) -> NDArray[np.float64]:
    x = np.arange(begin, end, 2.0)
    return np.column_stack((x, np.full(len(x), y)))


@pytest.mark.parametrize(("y", "lane"), [(-1.75, "east_2"), (-5.25, "east_1"), (-8.75, "east_0")])
def test_a_vehicle_in_its_lane_stays_in_it_with_noise(
    network: RoadNetwork, y: float, lane: str
) -> None:
    assert set(drive(network, straight(y + 0.4), noise_m=0.5)) == {lane}


def test_the_direction_decides_between_carriageways(network: RoadNetwork) -> None:
    # On the median the eastern carriageway is 2.75 m away, the western one 4.75 m.
    assert set(drive(network, straight(1.0))) == {"east_2"}
    assert set(drive(network, straight(1.0)[::-1])) == {"west_1"}


def test_no_vehicle_drives_along_a_lane_backwards(network: RoadNetwork) -> None:
    assert set(drive(network, straight(-5.25)[::-1])) == {""}


def test_a_lane_change_is_seen_within_half_a_second(network: RoadNetwork) -> None:
    line = straight(0.0)
    share = np.clip((np.arange(len(line)) - 40) / 40, 0.0, 1.0)  # four seconds
    line[:, 1] = -5.25 + 3.5 * (0.5 - 0.5 * np.cos(np.pi * share))
    lanes = drive(network, line, noise_m=0.1)
    change = lanes.index("east_2")
    assert lanes == ["east_1"] * change + ["east_2"] * (len(lanes) - change)
    assert 59 <= change <= 65


def test_beside_the_line_between_two_lanes_the_lane_does_not_flap(network: RoadNetwork) -> None:
    line = straight(-3.5)
    line[:, 1] += np.random.default_rng(5).normal(0.0, 0.15, len(line))
    lanes = drive(network, line, turned=False)
    changes = sum(a != b for a, b in pairwise(lanes))
    crossings = int(np.count_nonzero(np.diff(np.sign(line[:, 1] + 3.5))))
    assert crossings > 20
    assert changes <= crossings / 4


@pytest.mark.parametrize(("steps", "changes"), [(6, 0), (30, 2)])
def test_a_box_that_jumps_aside_takes_no_lane_with_it(
    network: RoadNetwork, steps: int, changes: int
) -> None:
    """For half a second the track is a lane beside its vehicle; if it stays there, so is that."""
    line = straight(-5.25)
    line[40 : 40 + steps, 1] += 3.0
    lanes = drive(network, line, turned=False)
    assert sum(a != b for a, b in pairwise(lanes)) == changes


def test_round_the_bend_and_down_the_ramp(network: RoadNetwork) -> None:
    roads = made_roads()
    for end, expected in (("bend", "bend_0"), ("ramp", "ramp_0")):
        line = np.concatenate([straight(-8.75), roads[end].centerline(0)[2:]])
        lanes = [lane for lane in drive(network, line, noise_m=0.1) if not lane.startswith(":")]
        assert lanes[0] == "east_0"
        assert lanes[-1] == expected
        right = sum(lane in ("east_0", expected) for lane in lanes)
        assert right / len(lanes) > 0.95  # at the very fork both lanes are one


def test_beside_the_road_there_is_no_lane(network: RoadNetwork) -> None:
    assert set(drive(network, straight(-30.0))) == {""}


def test_vehicles_do_not_disturb_each_other(network: RoadNetwork) -> None:
    """All vehicles at once, in any order, or one by one: the same lanes."""
    random = np.random.default_rng(2)
    y = random.choice([-1.75, -5.25, -8.75], 30) + random.normal(0.0, 0.5, 30)
    x0 = random.uniform(10.0, 100.0, 30)
    paths = np.stack([np.column_stack((x0 + 2.0 * k, y)) for k in range(60)])
    heading, sigma = np.zeros(30), np.full(30, 0.3)
    together, shuffled, single = (LaneMatcher(network, capacity=1) for _ in range(3))
    order = random.permutation(30)
    slots = np.arange(30)
    for matcher in (together, shuffled, single):
        matcher.forget(slots)
    for xy in paths:
        all_at_once = together.update(slots, xy, heading, sigma).lane
        other_order = shuffled.update(slots[order], xy[order], heading, sigma).lane
        assert (all_at_once[order] == other_order).all()
        for k in (0, 7):
            one = single.update(slots[k : k + 1], xy[k : k + 1], heading[:1], sigma[:1]).lane
            assert one[0] == all_at_once[k]
