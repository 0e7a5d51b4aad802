"""A camera's lanes against a map: what is wrong is found, what is right is left alone."""

from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from made_detections import detected, lane
from made_twin import made_network

from geoorbit_ros.core.errors import NoTrafficError, RoadNetworkError
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.polylines import offset_line
from geoorbit_ros.mapcheck.alignment import align
from geoorbit_ros.mapcheck.patch import patch_network
from geoorbit_ros.mapcheck.validation import say_alignment, validate
from geoorbit_ros.roadnet.network import RoadNetwork, load_network
from scores.map_errors import SHIFT_M, WIDTH_M, Error, plant


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> RoadNetwork:
    return load_network(made_network(tmp_path_factory.mktemp("net")))


@pytest.fixture(scope="module")
def lanes(network: RoadNetwork) -> list[Lane]:
    return detected(network)


def moved(lanes: list[Lane], shift: tuple[float, float], turn_deg: float = 0.0) -> list[Lane]:
    """Lanes as a camera sees them whose map frame is displaced."""
    cos, sin = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    turn = np.array([[cos, sin], [-sin, cos]])
    middle = np.concatenate([each.centerline_m for each in lanes]).mean(axis=0)
    return [
        replace(each, centerline_m=(each.centerline_m - middle) @ turn + middle + shift)
        for each in lanes
    ]


def test_a_right_map_has_no_finding(network: RoadNetwork, lanes: list[Lane]) -> None:
    found = validate(lanes, network)
    assert found.findings == ()
    assert not found.alignment.significant
    assert {"east_0", "bend_2", "west_1", "ramp_0"} <= set(found.discrepancies.compared)


@pytest.mark.parametrize("turn_deg", [0.0, 0.05, 0.6])
def test_a_displaced_camera_is_laid_on_the_map(
    network: RoadNetwork, lanes: list[Lane], turn_deg: float
) -> None:
    seen = moved(lanes, (0.8, -1.1), turn_deg)
    alignment = align(seen, network)
    assert alignment.significant
    # 0.05 degrees are 0.2 m at the ends of the lanes: no reason to turn a whole map.
    assert (alignment.turn_rad != 0.0) == (turn_deg > 0.1)
    # The bend makes both directions known.
    assert not alignment.unobserved.any()
    for there, here in zip(lanes, seen, strict=True):
        apart = alignment.points(here.centerline_m) - there.centerline_m
        assert np.abs(apart).max() < 0.4
    back = alignment.inverse_points(alignment.points(seen[0].centerline_m))
    assert np.abs(back - seen[0].centerline_m).max() < 1e-9


def test_along_a_straight_road_nothing_is_known(network: RoadNetwork, lanes: list[Lane]) -> None:
    straight = [
        replace(each, centerline_m=each.centerline_m[each.centerline_m[:, 0] < 280.0])
        for each in lanes[:5]
    ]
    alignment = align(moved(straight, (3.0, 1.0)), network)
    assert np.abs(alignment.unobserved @ [1.0, 0.0]) == pytest.approx(1.0, abs=1e-3)
    assert alignment.shift_m[0] == pytest.approx(0.0, abs=0.05)
    assert alignment.shift_m[1] == pytest.approx(-1.0, abs=0.15)
    assert "not known along 90°, where all lanes run" in say_alignment(alignment)


def test_one_displaced_road_of_two_is_one_finding(network: RoadNetwork, tmp_path: Path) -> None:
    (tmp_path / "plain").mkdir()
    plant("shifted", network, "west_0", tmp_path / "bad.net.xml", tmp_path / "plain")
    bad = load_network(tmp_path / "bad.net.xml", network.datum)
    # One lane of the right road against two of the displaced, and seen off its place.
    there, *_, back_0, back_1, _ = detected(network)
    there = replace(there, centerline_m=there.centerline_m + np.array([0.0, 0.3]), vehicles=3.0)
    seen = [
        replace(each, centerline_m=each.centerline_m[each.centerline_m[:, 0] < 280.0], sigma_m=0.18)
        for each in (there, back_0, back_1)
    ]
    found = validate(seen, bad).findings
    assert {(f.kind, f.lane_id) for f in found} == {("shifted", "west_0"), ("shifted", "west_1")}


@pytest.mark.parametrize("error", get_args(Error))
def test_a_planted_error_is_found_and_corrected(
    network: RoadNetwork, lanes: list[Lane], error: Error, tmp_path: Path
) -> None:
    (tmp_path / "plain").mkdir()
    (tmp_path / "out").mkdir()
    named = plant(error, network, "east_0", tmp_path / "bad.net.xml", tmp_path / "plain")
    bad = load_network(tmp_path / "bad.net.xml", network.datum)
    result = patch_network(lanes, bad, tmp_path / "out")
    findings = result.before.findings
    assert {f.kind for f in findings} == {error}
    sizes = {"shifted": SHIFT_M, "offset": SHIFT_M, "width": WIDTH_M}
    if error in sizes:
        for f in findings:
            assert abs(f.measured - f.expected) == pytest.approx(sizes[error], abs=0.25)
    if error in ("extra", "width"):
        assert [f.lane_id for f in findings] == [named]
    assert all(f.lane_id.startswith(named.rpartition("_")[0]) for f in findings)
    assert all(f.confidence > 0.8 for f in findings)
    assert result.after.findings == ()
    assert result.left == ()
    for name in ("east_0", "east_2", "bend_0", "west_0", "ramp_0"):
        true, corrected = network.line(network.number[name]), result.network
        line = corrected.line(corrected.number[name])
        for end in (0, -1):
            assert np.hypot(*(true[end] - line[end])) < 2.0  # junctions keep their outlines
        middle = true[len(true) // 2]
        assert np.hypot(*(line - middle).T).min() < 8.0
    assert len(result.network.lane_id) >= 9


def test_an_empty_lane_is_extra_only_beside_enough_traffic(
    network: RoadNetwork, tmp_path: Path
) -> None:
    (tmp_path / "plain").mkdir()
    plant("extra", network, "west_1", tmp_path / "bad.net.xml", tmp_path / "plain")
    bad = load_network(tmp_path / "bad.net.xml", network.datum)
    few = validate(detected(network, vehicles=3.0), bad)
    assert few.findings == ()
    assert [u.lane_id for u in few.discrepancies.unseen] == ["west_2"]
    assert "; 12 more vehicles" in few.discrepancies.unseen[0].sentence
    many = validate(detected(network, vehicles=20.0), bad)
    assert [(f.kind, f.lane_id) for f in many.findings] == [("extra", "west_2")]


def test_a_lane_that_is_half_in_view_is_found_empty_and_stays_in_the_map(
    network: RoadNetwork, tmp_path: Path
) -> None:
    (tmp_path / "plain").mkdir()
    (tmp_path / "out").mkdir()
    plant("extra", network, "west_1", tmp_path / "bad.net.xml", tmp_path / "plain")
    bad = load_network(tmp_path / "bad.net.xml", network.datum)
    half = [
        replace(each, centerline_m=each.centerline_m[: len(each.centerline_m) // 2])
        for each in detected(network, vehicles=20.0)
    ]
    result = patch_network(half, bad, tmp_path / "out")
    ((finding, reason),) = result.left
    assert (finding.kind, finding.lane_id) == ("extra", "west_2")
    assert "m were in view" in reason
    assert "west_2" in result.network.lane_id


@pytest.mark.parametrize(("used_m", "kinds"), [(8, ["extra"]), (32, [])])
def test_a_lane_that_is_left_early_is_not_extra(
    network: RoadNetwork, lanes: list[Lane], used_m: int, kinds: list[str]
) -> None:
    line = lanes[4].centerline_m[: used_m // 2]  # west_1, a point every 2 m, of some 200 m
    left = replace(lane(5, line, vehicles=1.0), status="tentative")
    found = validate([*lanes[:4], left, *lanes[5:]], network)
    assert [f.kind for f in found.findings] == kinds


@pytest.mark.parametrize(("seen_m", "found"), [(100.0, False), (280.0, True)])
@pytest.mark.parametrize("entered", [True, False])
def test_shortly_before_its_end_an_empty_lane_says_nothing(
    network: RoadNetwork, lanes: list[Lane], seen_m: float, found: bool, entered: bool
) -> None:
    """But where it can't be entered either, unlike those beside it, it is none."""
    k, beside = network.number["east_0"], network.number["east_1"]
    nexts = list(network.successors)
    nexts[k] = ()
    if not entered:
        nexts[network.number["west_0"]] = (beside,)  # any lane that leads into the next one
    ending = replace(network, successors=tuple(nexts))
    near = [
        replace(each, centerline_m=each.centerline_m[each.centerline_m[:, 0] > 300.0 - seen_m])
        for each in lanes[1:]
    ]
    result = validate(near, ending).discrepancies
    assert ("east_0" in {f.lane_id for f in result.findings}) == (found or not entered)
    assert ("east_0" in {u.lane_id for u in result.unseen}) == (not found and entered)


def test_at_a_junction_a_lane_that_leads_nowhere_is_not_left_but_wrong(
    network: RoadNetwork, lanes: list[Lane]
) -> None:
    near = [
        replace(each, centerline_m=each.centerline_m[each.centerline_m[:, 0] > 200.0])
        for each in lanes[1:]
    ]
    nexts = list(network.successors)
    nexts[network.number["east_0"]] = ()
    for turns in (False, True):
        if turns:
            nexts[network.number["east_1"]] += (network.number["west_0"],)
        found = validate(near, replace(network, successors=tuple(nexts))).findings
        assert ("east_0" in {f.lane_id for f in found}) == turns


def test_a_tentative_lane_shows_use_and_no_more(network: RoadNetwork, lanes: list[Lane]) -> None:
    seen = [replace(each, status="tentative") if each.lane_id == 1 else each for each in lanes]
    seen.append(replace(lane(9, lanes[0].centerline_m - np.array([0.0, 3.6])), status="tentative"))
    assert validate(seen, network).findings == ()


def test_without_confirmed_lanes_or_elsewhere_one_sentence(
    network: RoadNetwork, lanes: list[Lane]
) -> None:
    with pytest.raises(NoTrafficError, match="none confirmed"):
        validate([replace(lanes[0], status="tentative")], network)
    with pytest.raises(RoadNetworkError, match=r"nearest is \d+ m away"):
        validate(moved(lanes, (5000.0, 0.0)), network)


def test_traffic_that_leaves_a_lane_that_ends_does_not_displace_it(
    network: RoadNetwork, lanes: list[Lane]
) -> None:
    """It is a finding where the lane goes on, and where the lane is out of place all along."""
    k = network.number["west_0"]
    ends = tuple(() if j == k else nexts or (k,) for j, nexts in enumerate(network.successors))
    ending = replace(network, successors=ends)
    at = next(i for i, each in enumerate(lanes) if each.lane_id == 4)
    line = lanes[at].centerline_m
    unit = offset_line(line, 1.0) - line
    for move in (np.linspace(0.0, 1.6, len(line)), np.full(len(line), 0.8)):
        seen = list(lanes)
        seen[at] = replace(seen[at], centerline_m=line + move[:, None] * unit)
        on, off = (
            [f.lane_id for f in validate(seen, each).findings if f.kind == "shifted"]
            for each in (network, ending)
        )
        assert on == ["west_0"]
        assert off == (["west_0"] if np.ptp(move) == 0.0 else [])
