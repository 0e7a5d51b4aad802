"""Where traffic drives on the left: validation, patch and twin follow the network's own side."""

import json
from pathlib import Path

import numpy as np
import pytest
from made_detections import lane
from made_maps import ENGLAND, MadeCamera, road

from geoorbit_ros.cli.main import main
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.mapcheck.patch import patch_network
from geoorbit_ros.mapcheck.validation import validate
from geoorbit_ros.roadnet.driving_side import Side
from geoorbit_ros.roadnet.map_build import build_from_osm
from geoorbit_ros.roadnet.network import RoadNetwork, load_network
from scores.map_errors import Error, plant

NAMES = ("10_0", "10_1", "10_2", "-10_0", "-10_1", "-10_2")


def network_of(folder: Path, side: Side) -> RoadNetwork:
    area = road(ENGLAND, {"lanes": "6"}).write(folder / "area.osm")
    (folder / side).mkdir()
    return build_from_osm(area, folder / side, ENGLAND, side=side).network


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> RoadNetwork:
    return network_of(tmp_path_factory.mktemp("net"), "left")


def driven(network: RoadNetwork) -> list[Lane]:
    """A lane as detected for each lane of the network."""
    found = []
    for number, name in enumerate(NAMES, 1):
        begin, end = network.line(network.number[name])[[0, -1]]
        share = np.linspace(0.1, 0.9, 100)[:, None]
        found.append(lane(number, begin + share * (end - begin)))
    return found


def test_a_right_map_has_no_finding(network: RoadNetwork) -> None:
    found = validate(driven(network), network)
    assert (found.findings, found.notes) == ((), ())
    assert len(found.discrepancies.compared) == 6


@pytest.mark.parametrize(
    ("error", "name"),
    [
        *((error, name) for error in ("missing", "shifted", "width") for name in ("10_0", "-10_2")),
        ("missing", "10_1"),
        ("extra", "10_0"),
        ("extra", "-10_0"),
    ],
)
def test_a_planted_error_is_corrected(
    network: RoadNetwork, error: Error, name: str, tmp_path: Path
) -> None:
    for folder in ("plain", "out"):
        (tmp_path / folder).mkdir()
    plant(error, network, name, tmp_path / "bad.net.xml", tmp_path / "plain")
    bad = load_network(tmp_path / "bad.net.xml", network.datum)
    result = patch_network(driven(network), bad, tmp_path / "out")
    assert {f.kind for f in result.before.findings} == {error}
    assert result.after.findings == ()
    assert result.left == ()
    assert result.network.left_hand
    for each in NAMES:  # every lane is at its place, under its own index
        x = network.line(network.number[each])[:, 0].mean()
        assert result.network.line(result.network.number[each])[:, 0].mean() == pytest.approx(
            x, abs=0.1
        )


def test_a_map_made_for_the_other_side_is_told_and_not_turned(
    network: RoadNetwork, tmp_path: Path
) -> None:
    wrong = network_of(tmp_path, "right")
    result = patch_network(driven(network), wrong, tmp_path)
    (note,) = result.before.notes
    assert "made for traffic on the right, here it drives on the left" in note
    assert "geoorbit map build --driving-side left" in note
    assert {reason for _, reason in result.left} == {
        "the map is made for traffic on the other side"
    }
    assert result.network.point_m == pytest.approx(wrong.point_m, abs=0.01)


def test_the_twin_follows_traffic_on_the_left(tmp_path: Path) -> None:
    """From the extract to the twin, without a word about the side."""
    area = road(ENGLAND, {"lanes": "4"}).write(tmp_path / "area.osm")
    assert main(["map", "build", str(area), "--out", str(tmp_path / "map")]) == 0
    net = tmp_path / "map" / "network.net.xml"
    camera = MadeCamera(ENGLAND)
    for x, way in ((-1.75, 1), (-5.25, 1), (1.75, -1), (5.25, -1)):
        camera.drive(np.array([(x, -145.0 * way), (x, 145.0 * way)]), 5, begin_s=abs(x))
    tracks, calibration = camera.write(tmp_path)
    seen = ["--calibration", str(calibration)]
    bag = str(tmp_path / "bag")
    boxes = ["--tracks", str(tracks), "--camera-id", "uk"]
    assert main(["bag", "from-csv", *boxes, *seen, "--out", bag]) == 0
    out = tmp_path / "twin"
    assert main(["twin", "replay", bag, "--net", str(net), *seen, "--out", str(out)]) == 0
    score = json.loads((out / "score.json").read_text())
    assert score["vehicles_total"] == camera.tracks == 20
    assert score["beside_share"] == score["lane_error_share"] == 0.0
    assert score["off_road"] == score["handovers"] == 0
