"""Networks in the map frame: the right lanes at the right place on earth, or one sentence."""

import gzip
from pathlib import Path

import numpy as np
import pytest
from made_twin import DATUM, made_network, made_roads

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.errors import RoadNetworkError
from geoorbit_ros.roadnet.network import NO_LANE, RoadNetwork, load_network
from geoorbit_ros.roadnet.plane import NetworkPlane

UTM = "+proj=utm +zone=16 +datum=WGS84 +units=m +no_defs"


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_network(tmp_path_factory.mktemp("net"))


@pytest.fixture(scope="module")
def network(net: Path) -> RoadNetwork:
    return load_network(net)


def test_lanes_lie_where_the_roads_do(network: RoadNetwork) -> None:
    assert network.datum == DATUM  # the network's own frame is a map frame
    roads = made_roads()
    for name, road in roads.items():
        for lane in range(road.road.lanes):
            line = network.line(network.number[f"{name}_{lane}"])
            truth = road.centerline(lane)
            middle = np.abs(truth[:, None] - line[None]).sum(axis=2).min(axis=1)
            assert np.median(middle) < 0.03
            assert network.width_m[network.number[f"{name}_{lane}"]] == road.width_m


def test_lanes_know_their_neighbours_and_what_comes_next(network: RoadNetwork) -> None:
    number = network.number
    middle = number["east_1"]
    assert network.left[middle] == number["east_2"]
    assert network.right[middle] == number["east_0"]
    assert network.left[number["east_2"]] == network.right[number["east_0"]] == NO_LANE

    def reached(lane: str) -> set[str]:
        found, waiting = set(), [number[lane]]
        while waiting:
            for after in network.successors[waiting.pop()]:
                found.add(network.lane_id[after])
                waiting.append(after)
        return {name for name in found if not name.startswith(":")}

    assert reached("east_0") == {"bend_0", "ramp_0"}
    assert reached("east_2") == {"bend_2"}
    assert reached("west_0") == set()
    for lane in range(len(network)):
        for after in network.successors[lane]:
            assert lane in network.predecessors[after]


def test_another_datum_moves_the_map_and_not_the_road(net: Path, network: RoadNetwork) -> None:
    other = Datum(43.06, -89.33)
    moved = load_network(net, other)
    expected = other.to_local(*DATUM.to_geodetic(network.point_m).T)
    assert np.abs(moved.point_m - expected).max() < 1e-6


@pytest.mark.parametrize("seed", [1, 2])
def test_the_way_to_the_network_and_back_is_the_identity(seed: int) -> None:
    datum = Datum(43.044, -89.34)
    x, y = datum.to_local(43.044, -89.34)[0]
    plane = NetworkPlane(UTM, (-307727.31, -4768339.64), (0.0, 0.0, 2684.0, 66.0), datum, "net")
    points = np.random.default_rng(seed).uniform(-900.0, 900.0, (50, 2)) + np.array([x, y])
    assert np.abs(plane.to_map.points(plane.to_network.points(points)) - points).max() < 1e-6
    # The turn is what a short way turns by: 1.6 degrees, the zone's convergence.
    ahead = points + np.array([1.0, 0.0])
    step = plane.to_network.points(ahead) - plane.to_network.points(points)
    turn = plane.to_network.turn_rad(points)
    assert np.abs(np.arctan2(step[:, 1], step[:, 0]) - turn).max() < 1e-6
    assert abs(np.degrees(turn.mean()) + 1.6) < 0.05


def test_a_gzipped_network_is_the_same(net: Path, network: RoadNetwork, tmp_path: Path) -> None:
    packed = tmp_path / "net.xml.gz"
    packed.write_bytes(gzip.compress(net.read_bytes()))
    assert (load_network(packed).point_m == network.point_m).all()


def broken(text: str, kind: str) -> str:
    return {
        "cut off": text[: len(text) // 2],
        "not a network": "<osm><node/></osm>",
        "no projection": text.replace(DATUM.proj_string, "!"),
        "unknown projection": text.replace(DATUM.proj_string, "+proj=nonsense"),
        "no roads": text.replace("<lane ", '<lane disallow="all" '),
        "no number": text.replace('width="3.500"', 'width="wide"').replace(
            'width="3.50"', 'width="wide"'
        ),
    }[kind]


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("cut off", "broken XML"),
        ("not a network", "a file of <osm>"),
        ("no projection", "a network without projection"),
        ("unknown projection", "+proj=nonsense"),
        ("no roads", "no lane for road vehicles"),
        ("no number", "wide"),
    ],
)
def test_what_is_no_network_is_one_sentence(
    net: Path, tmp_path: Path, kind: str, said: str
) -> None:
    file = tmp_path / "bad.net.xml"
    text = broken(net.read_text(), kind)
    if kind == "no roads":
        text = text.replace("function='walkingarea' id", "function='walkingarea' id", 1)
        import re

        text = re.sub(r"(<edge function='walkingarea'[^>]*?) function=\"internal\"", r"\1", text)
    file.write_text(text)
    with pytest.raises(RoadNetworkError) as error:
        load_network(file)
    assert said in str(error.value)
    assert str(file) in str(error.value)
    assert "\n" not in str(error.value)


def test_a_file_that_is_not_there_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(RoadNetworkError, match="no such file"):
        load_network(tmp_path / "no.net.xml")
