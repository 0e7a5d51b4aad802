"""Who may use which lane, by the tags of OpenStreetMap, on both sides of the road."""

from pathlib import Path

import numpy as np
import pytest
from made_maps import BAVARIA, ENGLAND, MadeExtract, road

from geoorbit_ros.roadnet.driving_side import SIDES, Side
from geoorbit_ros.roadnet.lane_access import WayCounts, lane_plans, prepared
from geoorbit_ros.roadnet.map_build import BuiltMap, build_from_osm

USUAL = frozenset({"passenger", "hov", "taxi", "bus", "coach", "truck", "bicycle", "emergency"})
ONE_WAY = {"oneway": "yes"}
SHORT = {"passenger": "p", "hov": "h", "taxi": "t", "bus": "b", "truck": "l", "bicycle": "c"}


def users(tags: dict[str, str], lanes: int, side: Side, forward: bool = True) -> list[str]:
    """The users of each lane from left to right, in letters of `SHORT`; `=` for all."""
    plans = lane_plans("7", tags, forward, side, [USUAL] * lanes, WayCounts())
    found = []
    for plan in plans if side == "left" else plans[::-1]:
        letters = "".join(v for k, v in SHORT.items() if k in plan.allowed)
        found.append("m" if plan.both_ways else "=" if plan.allowed >= USUAL else letters)
    return found


FROM_LEFT_TO_RIGHT: list[tuple[dict[str, str], list[str]]] = [
    ({"bus:lanes": "yes|yes|designated", "vehicle:lanes": "yes|yes|no"}, ["=", "=", "b"]),
    ({"bus:lanes": "||designated"}, ["=", "=", "b"]),
    ({"bus:lanes": "designated||"}, ["b", "=", "="]),
    ({"psv:lanes": "||designated", "motor_vehicle:lanes": "||no"}, ["=", "=", "tb"]),
    ({"access:lanes": "yes|yes|no", "bus:lanes": "||yes"}, ["=", "=", "b"]),
    ({"vehicle:lanes": "yes|no|no", "psv:lanes": "||yes"}, ["=", "", "tb"]),
    ({"hov:lanes": "designated||"}, ["h", "=", "="]),
    ({"hov:lanes": "designated||", "motor_vehicle:lanes": "no||"}, ["h", "=", "="]),
    ({"hgv:lanes": "no||"}, ["phtbc", "=", "="]),
    ({"bicycle:lanes": "no||designated", "vehicle:lanes": "||no"}, ["phtbl", "=", "c"]),
    ({"taxi:lanes": "||designated", "bus:lanes": "||designated"}, ["=", "=", "tb"]),
    ({"bus:lanes": "||designated", "motorcar:lanes": "||yes"}, ["=", "=", "="]),
    ({"bus:lanes": "yes|designated"}, ["=", "=", "="]),  # one too few: not used
    ({"access:lanes": "||"}, ["=", "=", "="]),
    ({"access": "no", "bus": "yes"}, ["b", "b", "b"]),
    ({"motor_vehicle": "no"}, ["c", "c", "c"]),
    ({"motor_vehicle": "private"}, ["=", "=", "="]),
    ({"hgv": "no"}, ["phtbc", "phtbc", "phtbc"]),
    ({"hov": "designated"}, ["htblc", "htblc", "htblc"]),
    ({"vehicle": "no", "psv": "designated"}, ["tb", "tb", "tb"]),
]


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize(("tags", "expected"), FROM_LEFT_TO_RIGHT, ids=lambda v: str(v)[:60])
def test_lists_run_from_left_to_right_on_either_side(
    tags: dict[str, str], expected: list[str], side: Side
) -> None:
    assert users(tags | ONE_WAY, 3, side) == expected
    turned = {k + ":backward" if ":lanes" in k else k: v for k, v in tags.items()}
    assert users(turned, 3, side, forward=False) == expected


@pytest.mark.parametrize(
    ("tags", "right", "left"),
    [
        ({"lanes:psv": "1"}, ["=", "=", "tbc"], ["tbc", "=", "="]),
        ({"lanes:bus": "2"}, ["=", "bc", "bc"], ["bc", "bc", "="]),
        ({"lanes:hov": "1"}, ["h" + "c", "=", "="], ["=", "=", "h" + "c"]),
        ({"busway": "lane"}, ["=", "=", "bc"], ["bc", "=", "="]),
        ({"busway:right": "lane"}, ["=", "=", "bc"], ["=", "=", "bc"]),
        ({"busway:left": "lane"}, ["bc", "=", "="], ["bc", "=", "="]),
        ({"cycleway": "lane"}, ["phtbl"] * 3 + ["c"], ["c"] + ["phtbl"] * 3),
        ({"cycleway:both": "lane"}, ["phtbl"] * 3 + ["c"], ["c"] + ["phtbl"] * 3),
        ({"cycleway:right": "lane"}, ["phtbl"] * 3 + ["c"], ["="] * 3),
        ({"cycleway:left": "lane"}, ["="] * 3, ["c"] + ["phtbl"] * 3),
        ({"cycleway": "track"}, ["="] * 3, ["="] * 3),
        ({"cycleway:right": "lane", "cycleway:right:oneway": "-1"}, ["="] * 3, ["="] * 3),
        (
            {"bicycle:lanes": "|||designated", "vehicle:lanes": "|||no"},
            ["phtbl"] * 3 + ["c"],
            ["="] * 3,  # between the lanes and the middle of the road: not made
        ),
    ],
    ids=lambda v: str(v)[:60],
)
def test_what_is_outside_depends_on_the_side(
    tags: dict[str, str], right: list[str], left: list[str]
) -> None:
    assert users(tags | ONE_WAY, 3, "right") == right
    assert users(tags | ONE_WAY, 3, "left") == left


@pytest.mark.parametrize("side", SIDES)
def test_both_directions_of_a_road(side: Side) -> None:
    there, back = ("right", "left") if side == "right" else ("left", "right")
    for place, ahead, backward in ((there, True, False), (back, False, True)):
        for key, letter in (("busway", "bc"), ("cycleway", "c")):
            tags = {f"{key}:{place}": "lane"}
            assert (letter in users(tags, 2, side, True)) == ahead
            assert (letter in users(tags, 2, side, False)) == backward
    assert "tbc" in users({"lanes:psv:backward": "1"}, 2, side, False)
    assert users({"lanes:psv:backward": "1"}, 2, side, True) == ["=", "="]
    assert users({"bus:lanes": "|designated"}, 2, side, False) == ["=", "="]


@pytest.mark.parametrize(
    "tags",
    [
        {"lanes": "5", "lanes:both_ways": "1"},
        {"lanes": "5", "lanes:forward": "2", "lanes:backward": "2", "lanes:both_ways": "1"},
        {"lanes": "5", "lanes:forward": "2", "lanes:both_ways": "1"},
        {"lanes": "5", "centre_turn_lane": "yes"},
        {"lanes": "5", "center_turn_lane": "yes"},
        {"lanes:forward": "2", "lanes:backward": "2", "lanes:both_ways": "1"},
        {"lanes": "5", "lanes:both_ways": "1", "turn:lanes:both_ways": "left"},
    ],
    ids=lambda v: str(v)[:60],
)
@pytest.mark.parametrize("datum", [BAVARIA, ENGLAND])
def test_a_turn_lane_lies_in_the_middle_of_the_road(
    tmp_path: Path, tags: dict[str, str], datum: object
) -> None:
    built = build(tmp_path, road(datum, tags))  # type: ignore[arg-type]
    network, sign = built.network, -1.0 if datum == ENGLAND else 1.0
    assert sum(~network.internal) == 6
    for name in ("10", "-10"):
        way = 1.0 if name == "10" else -1.0
        for index, x in enumerate((7.0, 3.5, 0.0)):
            k = network.number[f"{name}_{index}"]
            assert network.line(k)[0, 0] == pytest.approx(way * sign * x, abs=0.02)
            assert network.both_ways[k] == (index == 2)
    assert any("2 for turns from both sides" in text for text in built.said)


def build(folder: Path, extract: MadeExtract) -> BuiltMap:
    (folder / "map").mkdir()
    return build_from_osm(extract.write(folder / "a.osm"), folder / "map", extract.datum)


@pytest.mark.parametrize(
    ("tags", "expected"),
    [
        ({"oneway": "yes", "busway": "opposite_lane"}, {"oneway": "yes", "oneway:bus": "no"}),
        ({"oneway": "yes", "oneway:psv": "no"}, {"oneway": "yes", "oneway:bus": "no"}),
        ({"oneway": "yes", "oneway:bicycle": "no", "cycleway": "opposite"}, {"oneway": "yes"}),
        ({"highway": "cycleway"}, {"highway": "cycleway"}),
        ({"busway": "lane", "lanes": "2"}, {"lanes": "2"}),
        ({"lanes": "3", "lanes:both_ways": "0"}, {"lanes": "3", "lanes:both_ways": "0"}),
    ],
)
def test_what_netconvert_reads(tags: dict[str, str], expected: dict[str, str]) -> None:
    assert prepared(tags) == expected


def test_a_contraflow_bus_lane_runs_the_other_way(tmp_path: Path) -> None:
    tags = {"oneway": "yes", "lanes": "2", "busway": "opposite_lane"}
    network = build(tmp_path, road(BAVARIA, tags)).network
    users_of = {network.lane_id[k]: network.users(k) for k in range(len(network))}
    assert users_of == {"10_0": "", "10_1": "", "-10_0": "buses and bicycles"}
    assert network.line(network.number["-10_0"])[0, 1] > 0.0


def test_edges_of_one_way_keep_their_own_users(tmp_path: Path) -> None:
    """netconvert joins edges that are alike; those before and after a bus lane begins are not."""
    extract = MadeExtract(BAVARIA)
    plain = {"highway": "primary", "oneway": "yes", "lanes": "2"}
    extract.way(1, [(0.0, -200.0), (0.0, -100.0), (0.0, 0.0)], plain)
    extract.way(2, [(0.0, 0.0), (0.0, 100.0)], plain | {"bus:lanes": "|designated"})
    extract.way(3, [(0.0, 100.0), (0.0, 200.0)], plain)
    network = build(tmp_path, extract).network
    outside = np.flatnonzero(~network.internal).tolist()
    users_of = {network.lane_id[k]: network.users(k) for k in outside}
    assert users_of == {"1_0": "", "1_1": "", "2_0": "buses", "2_1": "", "3_0": "", "3_1": ""}
    assert np.ptp(network.point_m[:, 1]) == pytest.approx(400.0, abs=0.5)


def test_what_can_t_be_followed_is_told(tmp_path: Path) -> None:
    extract = MadeExtract(BAVARIA)
    for number, tags in enumerate(
        (
            {"bus:lanes": "yes|designated|yes"},
            {"bus:lanes:conditional": "|designated @ (Mo-Fr 07:00-09:00)"},
            {"cycleway": "opposite_lane"},
        ),
        1,
    ):
        line = [(20.0 * number, -100.0), (20.0 * number, 100.0)]
        extract.way(number, line, {"highway": "primary", "oneway": "yes", "lanes": "2", **tags})
    said = list(build(tmp_path, extract).report.sentences())
    assert len(said) == 3
    for number, part in ((1, "don't fit"), (2, ":conditional"), (3, "against the traffic")):
        assert any(part in text and f"way {number}" in text for text in said)
