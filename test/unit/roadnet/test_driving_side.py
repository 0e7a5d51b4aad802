"""The side of the road: by tags, by the place, as told, and never guessed."""

from pathlib import Path

import numpy as np
import pytest
from made_maps import BAVARIA, ENGLAND, MadeExtract, road

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.cli.main import main
from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.core.lanes import LaneMap
from geoorbit_ros.exchange.sumo import to_sumo
from geoorbit_ros.lanes.geojson import LaneFile
from geoorbit_ros.roadnet.driving_side import (
    AREAS,
    MapEvidence,
    Side,
    choose_side,
    side_at,
    side_doubt,
)
from geoorbit_ros.roadnet.map_build import build_from_network, build_from_osm
from geoorbit_ros.roadnet.network import RoadNetwork, load_network
from geoorbit_ros.roadnet.osm_extract import read_extract
from geoorbit_ros.roadnet.reference_lanes import reference_lanes

EVERYWHERE = np.array([(-900.0, -900.0), (900.0, -900.0), (900.0, 900.0), (-900.0, 900.0)])
PLACES: dict[str, tuple[float, float, Side | None]] = {
    "London": (51.51, -0.13, "left"),
    "Dublin": (53.35, -6.26, "left"),
    "Belfast": (54.60, -5.93, "left"),
    "Saint Helier": (49.19, -2.10, "left"),
    "Cherbourg": (49.64, -1.62, "right"),
    "Dover": (51.13, 1.31, "left"),
    "Calais": (50.95, 1.86, "right"),
    "Gibraltar": (36.14, -5.35, "right"),
    "Valletta": (35.90, 14.51, "left"),
    "Nicosia": (35.17, 33.36, "left"),
    "Cape Town": (-33.92, 18.42, "left"),
    "Johannesburg": (-26.20, 28.05, "left"),
    "Luanda": (-8.84, 13.23, "right"),
    "Lusaka": (-15.42, 28.28, "left"),
    "Kolwezi": (-10.71, 25.47, "right"),
    "Nairobi": (-1.29, 36.82, "left"),
    "Kampala": (0.35, 32.58, "left"),
    "Kigali": (-1.94, 30.06, "right"),
    "Karachi": (24.86, 67.01, "left"),
    "Delhi": (28.61, 77.21, "left"),
    "Dhaka": (23.81, 90.41, "left"),
    "Colombo": (6.93, 79.85, "left"),
    "Mumbai": (19.08, 72.88, "left"),
    "Kathmandu": (27.72, 85.32, "left"),
    "Kabul": (34.53, 69.17, "right"),
    "Bangkok": (13.75, 100.50, "left"),
    "Yangon": (16.80, 96.15, "right"),
    "Singapore": (1.35, 103.82, "left"),
    "Hong Kong": (22.28, 114.16, "left"),
    "Guangzhou": (23.13, 113.26, "right"),
    "Tokyo": (35.68, 139.69, "left"),
    "Taipei": (25.03, 121.57, "right"),
    "Sydney": (-33.87, 151.21, "left"),
    "Suva": (-18.14, 178.44, "left"),
    "Fiji beyond 180 degrees": (-16.80, -179.97, "left"),
    "Apia": (-13.83, -171.77, "left"),
    "Pago Pago": (-14.28, -170.70, "right"),
    "Charlotte Amalie": (18.34, -64.93, "left"),
    "San Juan": (18.47, -66.11, "right"),
    "Roseau": (15.30, -61.39, "left"),
    "Fort-de-France": (14.60, -61.07, "right"),
    "Kingston": (17.97, -76.79, "left"),
    "Georgetown": (6.80, -58.16, "left"),
    "Boa Vista": (2.82, -60.67, "right"),
    "Stanley": (-51.70, -57.85, "left"),
    "New York": (40.71, -74.01, "right"),
    "Paris": (48.86, 2.35, "right"),
    "Vientiane": (17.967, 102.60, None),
    "Shenzhen": (22.54, 114.06, None),
    "Macau": (22.19, 113.55, None),
    "Zhuhai": (22.27, 113.57, None),
    "Lubumbashi": (-11.66, 27.48, None),
}


@pytest.mark.parametrize("name", PLACES)
def test_the_side_of_a_place(name: str) -> None:
    latitude, longitude, side = PLACES[name]
    assert side_at(latitude, longitude) == side


def test_the_table_is_drawn_by_hand() -> None:
    lines = [line for line in AREAS.read_text().splitlines() if not line.startswith("#")]
    assert lines[0] == "area,longitude,latitude,border_km"
    names = [line.split(",")[0] for line in lines[1:]]
    runs = [name for k, name in enumerate(names) if k == 0 or names[k - 1] != name]
    assert len(runs) == len(set(runs)), "the corners of an area stand together"
    corners = np.array([line.split(",")[1:3] for line in lines[1:]], dtype=np.float64) * 20.0
    assert corners == pytest.approx(np.round(corners)), "rounded to 0.05 degrees or more"


@pytest.mark.parametrize(
    ("given", "tagged", "place", "side", "words"),
    [
        (None, {}, ENGLAND, "left", "by the place (51.600, -1.200)."),
        (None, {}, BAVARIA, "right", "by the place"),
        (None, {"left": 900.0}, BAVARIA, "left", "by the tags driving_side of its roads; at 48.2"),
        (None, {"right": 90.0}, ENGLAND, "left", "90 m of its roads are tagged otherwise"),
        (None, {"right": 90.0}, Datum(22.54, 114.06), "right", "by the tags"),
        ("right", {}, ENGLAND, "right", "as --driving-side says; at 51.600, -1.200 one drives on"),
        ("right", {"left": 900.0}, ENGLAND, "right", "its tags say left"),
        ("left", {}, Datum(22.54, 114.06), "left", "as --driving-side says."),
    ],
)
def test_what_decides(
    given: Side | None, tagged: dict[Side, float], place: Datum, side: Side, words: str
) -> None:
    found = choose_side(given, MapEvidence(tagged, {}, 1000.0), place, "area.osm")
    assert found.side == side
    assert words in found.sentence


def test_near_a_border_the_user_is_asked() -> None:
    with pytest.raises(ParameterError, match=r"area\.osm.*border.*--driving-side left or right"):
        choose_side(None, MapEvidence({}, {}, 1000.0), Datum(17.967, 102.60), "area.osm")
    both = MapEvidence({}, {"left": 1, "right": 2}, 1000.0)
    with pytest.raises(ParameterError, match="--driving-side"):
        choose_side(None, both, Datum(17.967, 102.60), "area.osm")


def built(tmp_path: Path, extract: MadeExtract, side: Side | None = None) -> RoadNetwork:
    folder = tmp_path / "map"
    folder.mkdir()
    return build_from_osm(
        extract.write(tmp_path / "area.osm"), folder, extract.datum, side=side
    ).network


def middle_x(network: RoadNetwork, lane_id: str) -> float:
    return float(np.median(network.line(network.number[lane_id])[:, 0]))


@pytest.mark.parametrize(
    ("tags", "datum", "given", "sign"),
    [
        ({"driving_side": "left"}, ENGLAND, None, -1.0),
        ({}, ENGLAND, None, -1.0),
        ({}, BAVARIA, None, 1.0),
        ({"driving_side": "left"}, BAVARIA, None, -1.0),
        ({}, BAVARIA, "left", -1.0),
        ({"driving_side": "left"}, ENGLAND, "right", 1.0),
    ],
)
def test_lanes_lie_on_their_side(
    tmp_path: Path, tags: dict[str, str], datum: Datum, given: Side | None, sign: float
) -> None:
    network = built(tmp_path, road(datum, {"lanes": "4", **tags}), given)
    assert network.left_hand == (sign < 0)
    for lane, x in (("10_0", 5.25), ("10_1", 1.75), ("-10_1", -1.75), ("-10_0", -5.25)):
        assert middle_x(network, lane) == pytest.approx(sign * x, abs=0.02)
    left = network.lane_id[network.left[network.number["10_0" if sign > 0 else "10_1"]]]
    assert left == ("10_1" if sign > 0 else "10_0")
    for seen in reference_lanes(network, EVERYWHERE):
        north = abs(seen.heading_deg - 180.0) > 90.0
        assert (seen.centerline_m[0, 0] * sign > 0) == north


def test_the_command_tells_the_side(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    area = road(ENGLAND, {"lanes": "2"}).write(tmp_path / "a.osm")
    assert main(["map", "build", str(area), "--out", str(tmp_path / "out")]) == 0
    assert "Traffic drives on the left, by the place" in " ".join(capsys.readouterr().out.split())
    assert '"side": "left"' in (tmp_path / "out" / "map.json").read_text()
    assert main(["map", "build", str(area), "--out", str(tmp_path / "b"), "--driving-side", "up"])
    assert "expected left or right" in " ".join(capsys.readouterr().err.split())


def test_a_network_keeps_its_side(tmp_path: Path) -> None:
    net = built(tmp_path, road(ENGLAND, {"lanes": "4"})).path
    (tmp_path / "again").mkdir()
    again = build_from_network(net, tmp_path / "again", Datum(51.601, -1.201))
    assert again.network.left_hand
    assert load_network(net).left_hand
    with pytest.raises(ParameterError, match="made for traffic on the left"):
        build_from_network(net, tmp_path / "again", None, "right")


def test_a_network_of_the_other_side_is_told(tmp_path: Path) -> None:
    net = built(tmp_path, road(ENGLAND, {"lanes": "4"}), "right").path
    (tmp_path / "again").mkdir()
    said = build_from_network(net, tmp_path / "again").said
    assert any("drives on the right" in s and "one drives on the left" in s for s in said)
    assert side_doubt("left", ENGLAND) == ""


@pytest.mark.parametrize(("datum", "clockwise"), [(ENGLAND, True), (BAVARIA, False)])
@pytest.mark.parametrize("kind", ["roundabout", "circular"])
def test_roundabouts_turn_the_right_way(
    tmp_path: Path, datum: Datum, clockwise: bool, kind: str
) -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 13)[:-1] * (-1.0 if clockwise else 1.0)
    ring = [(round(20.0 * np.cos(a), 3), round(20.0 * np.sin(a), 3)) for a in angle.tolist()]
    extract = MadeExtract(datum)
    extract.way(1, [*ring, ring[0]], {"highway": "primary", "junction": kind})
    for number, k in enumerate((0, 3, 6, 9), 2):
        end = (ring[k][0] * 6.0, ring[k][1] * 6.0)
        extract.way(number, [ring[k], end], {"highway": "primary", "lanes": "2"})
    network = built(tmp_path, extract)
    rings = read_extract(tmp_path / "area.osm").evidence.rings
    assert rings == {"left": int(clockwise), "right": int(not clockwise)}
    text = network.path.read_text()
    assert text.count("<roundabout ") == 1
    inside = [
        k
        for k in range(len(network))
        if not network.internal[k] and np.hypot(*network.line(k).T).max() < 24.0
    ]
    assert len(inside) >= 4
    for k in inside:
        line = network.line(k)
        (x, y), (dx, dy) = line[:-1].T, np.diff(line, axis=0).T
        turn = (x * dy - y * dx).sum()
        assert (turn < 0) == clockwise
        # The arms lead into the ring, and out of it.
    for arm in ("2", "3", "4", "5"):
        leads = {network.edge_id[j] for j in network.successors[network.number[f"-{arm}_0"]]}
        assert leads


@pytest.mark.parametrize(("direction", "side"), [("clockwise", "left"), ("anticlockwise", "right")])
def test_near_a_border_roundabouts_decide(tmp_path: Path, direction: str, side: Side) -> None:
    extract = road(Datum(17.967, 102.60), {"lanes": "2"})
    extract.node((0.0, 150.0), highway="mini_roundabout", direction=direction)
    network = built(tmp_path, extract)
    assert network.left_hand == (side == "left")
    found = choose_side(None, MapEvidence({}, {"left": 2}, 9.0), BAVARIA, "a")
    assert found.side == "right"
    assert "2 of its roundabouts turn clockwise" in found.sentence


def test_an_exported_network_has_its_lanes_where_they_are_and_its_side(tmp_path: Path) -> None:
    network = built(tmp_path, road(ENGLAND, {"lanes": "4"}))
    lanes = reference_lanes(network, EVERYWHERE)
    for side in ("left", "right"):
        file = tmp_path / f"{side}.net.xml"
        file.write_text(to_sumo(LaneFile(LaneMap(0, lanes), ENGLAND, "c"), side))
        exported = load_network(file)
        assert exported.left_hand == (side == "left")
        xs = sorted(round(float(np.median(exported.line(k)[:, 0])), 2) for k in range(4))
        assert xs == [-5.25, -1.75, 1.75, 5.25]
        for k in range(4):
            if (j := int(exported.left[k])) >= 0:
                step = exported.line(k)[-1] - exported.line(k)[0]
                gap = exported.line(j)[0] - exported.line(k)[0]
                assert step[0] * gap[1] - step[1] * gap[0] > 0
