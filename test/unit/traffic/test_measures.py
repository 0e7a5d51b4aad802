"""Measures by their definitions, on traffic of which everything is known."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.core.tables import BUS, CAR, MOTORCYCLE, TRUCK, UNKNOWN_CLASS
from geoorbit_ros.traffic.class_schemes import SCHEMES, SchemeFile, scheme_of
from geoorbit_ros.traffic.interval_clock import NS, ObservedTime
from geoorbit_ros.traffic.measures import Traffic, headways_s, measure
from geoorbit_ros.traffic.records import CROSSING_DTYPE, PASSAGE_DTYPE, PIECE_DTYPE
from geoorbit_ros.traffic.stations import MeasuredLanes

LANES = MeasuredLanes(
    np.array([4, 7, 2]), np.array([1, 2, 1]), np.array([100.0, 100.0, 50.0]), np.array([1, 1, 2])
)
NAN = float("nan")


def made_up(
    lane: int, at_s: NDArray[np.float64], speed: float, class_id: int = CAR, length_m: float = 4.5
) -> tuple[NDArray[np.void], NDArray[np.void]]:
    """Passages and crossings of vehicles that cross the middle of a lane at some times."""
    length = float(LANES.length_m[LANES.lane_id == lane][0])
    crossings = np.zeros(len(at_s), CROSSING_DTYPE)
    passages = np.zeros(len(at_s), PASSAGE_DTYPE)
    for table in (crossings, passages):
        table["vehicle_id"] = np.arange(len(at_s)) + 1 + 1000 * lane + 100_000 * class_id
        table["lane_id"], table["class_id"], table["length_m"] = lane, class_id, length_m
        table["speed_mps"], table["speed_sigma_mps"] = speed, 0.2
    crossings["stamp_ns"] = np.round(at_s * NS)
    over_ns = round(0.5 * np.nan_to_num(length_m) / speed * NS)
    crossings["front_ns"] = crossings["stamp_ns"] - over_ns
    crossings["rear_ns"] = crossings["stamp_ns"] + over_ns
    crossings["station_id"] = LANES.station[LANES.lane_id == lane][0]
    half_ns = 0.5 * length / speed * NS
    passages["first_ns"] = crossings["stamp_ns"] - round(half_ns)
    passages["last_ns"] = crossings["stamp_ns"] + round(half_ns)
    passages["last_arc_m"] = length
    return passages, crossings


def watched(*spans_s: tuple[float, float]) -> ObservedTime:
    return ObservedTime(spans_ns=[(round(a * NS), round(b * NS)) for a, b in spans_s])


def traffic(*parts: tuple[NDArray[np.void], NDArray[np.void]], observed: ObservedTime) -> Traffic:
    passages, crossings = (np.concatenate(tables) for tables in zip(*parts, strict=True))
    pieces = np.zeros(len(passages), PIECE_DTYPE)
    for name in set(PIECE_DTYPE.names or ()) - {"way_m"}:
        pieces[name] = passages[name]
    pieces["way_m"] = passages["last_arc_m"] - passages["first_arc_m"]
    return Traffic(passages, crossings, pieces, observed, LANES, SCHEMES["coco"])


def row(table: NDArray[np.void], start_s: float, lane: int, category: int = -1) -> Any:
    chosen = (table["start_ns"] == round(start_s * NS)) & (table["lane_id"] == lane)
    (found,) = table[chosen & (table["category"] == category) & (table["station_id"] == 1)]
    return found


EVERY_3_S = np.arange(1.5, 300.0, 3.0)


def test_who_stands_on_the_line_covers_it_in_each_interval_that_it_stands_in() -> None:
    passages, crossings = made_up(4, np.array([130.0]), 0.1)
    crossings["front_ns"], crossings["rear_ns"] = 30 * NS, 150 * NS
    made = traffic((passages, crossings), observed=watched((0, 240)))
    edges = np.array([0, 60, 120, 180, 240]) * NS
    for rows in (
        measure(made, edges),
        np.concatenate([measure(made, edges[k : k + 2]) for k in range(4)]),
    ):
        found = [row(rows, start_s, 4)["occupancy_percent"] for start_s in (0, 60, 120, 180)]
        assert found == pytest.approx([50.0, 100.0, 50.0, 0.0])


def test_steady_traffic_has_the_flow_speed_density_and_headway_that_it_was_made_with() -> None:
    made = traffic(made_up(4, EVERY_3_S, 20.0), observed=watched((0, 300)))
    found = row(measure(made, np.array([0, 300]) * NS), 0, 4)
    assert found["volume"] == 100
    assert found["observed"] == 1.0
    assert found["flow_veh_per_h"] == pytest.approx(1200.0)
    assert found["time_mean_speed_kmh"] == pytest.approx(72.0)
    assert found["space_mean_speed_kmh"] == pytest.approx(72.0)
    assert found["speed_p85_kmh"] == pytest.approx(72.0)
    # The fundamental relation, flow = density * speed, but for vehicles at either end of the time.
    assert found["density_veh_per_km"] == pytest.approx(1200.0 / 72.0, rel=0.01)
    assert found["headway_mean_s"] == pytest.approx(3.0)
    assert found["gap_mean_s"] == pytest.approx(3.0 - 4.5 / 20.0)
    assert found["occupancy_percent"] == pytest.approx(100 * (4.5 / 20.0) / 3.0)
    assert found["platoon_share"] == 0.0


def test_slow_vehicles_weigh_more_in_the_space_mean_than_in_the_time_mean() -> None:
    slow, fast = made_up(4, EVERY_3_S[::2], 10.0), made_up(4, EVERY_3_S[1::2], 30.0, TRUCK)
    found = row(
        measure(traffic(slow, fast, observed=watched((0, 300))), np.array([0, 300]) * NS), 0, 4
    )
    assert found["time_mean_speed_kmh"] == pytest.approx(3.6 * 20.0)
    assert found["space_mean_speed_kmh"] == pytest.approx(3.6 * 15.0, rel=0.02)
    assert found["heavy_share"] == 0.5


def test_volumes_of_classes_and_lanes_add_up_to_the_station() -> None:
    random = np.random.default_rng(1)
    parts = [
        made_up(lane, np.sort(random.uniform(0, 900, 30 + 5 * k)), 15.0 + k, class_id)
        for k, (lane, class_id) in enumerate(
            (lane, c) for lane in (4, 7, 2) for c in (CAR, TRUCK, UNKNOWN_CLASS, BUS)
        )
    ]
    table = measure(traffic(*parts, observed=watched((0, 900))), np.arange(0, 901, 300) * NS)
    every = table[table["category"] == -1]
    for start in np.unique(table["start_ns"]):
        for station in (1, 2):
            here = every[(every["start_ns"] == start) & (every["station_id"] == station)]
            lanes, total = here[here["lane_id"] > 0], here[here["lane_id"] == 0]
            assert lanes["volume"].sum() == total["volume"][0]
            assert lanes["lane_share"].sum() == pytest.approx(1.0)
        for lane in (4, 7, 2):
            one = table[(table["start_ns"] == start) & (table["lane_id"] == lane)]
            classes = one[one["category"] >= 0]
            assert classes["volume"].sum() == one[one["category"] == -1]["volume"][0]
    assert every[every["lane_id"] > 0]["volume"].sum() == sum(len(c) for _, c in parts)


def test_what_was_not_watched_is_missing_and_never_a_zero() -> None:
    made = traffic(made_up(4, EVERY_3_S[:50], 20.0), observed=watched((0, 150)))
    table = measure(made, np.array([0, 100, 200, 300]) * NS)
    first, half, none = (row(table, start, 4) for start in (0, 100, 200))
    assert first["observed"] == 1.0
    assert half["observed"] == pytest.approx(0.5)
    assert half["flow_veh_per_h"] == pytest.approx(first["flow_veh_per_h"], rel=0.05)
    assert none["observed"] == 0.0
    assert np.isnan([none["flow_veh_per_h"], none["density_veh_per_km"]]).all()
    empty = row(
        measure(
            traffic(made_up(7, EVERY_3_S, 20.0), observed=watched((0, 300))),
            np.array([0, 300]) * NS,
        ),
        0,
        4,
    )
    assert empty["flow_veh_per_h"] == 0.0
    assert empty["volume"] == 0
    assert np.isnan(empty["time_mean_speed_kmh"])


def test_no_headway_reaches_over_an_outage_and_each_lane_has_its_own() -> None:
    _, crossings = made_up(4, np.array([1.0, 3.0, 50.0, 52.5]), 20.0, length_m=NAN)
    _, beside = made_up(7, np.array([2.0, 51.0]), 20.0)
    headway, gap = headways_s(np.concatenate((crossings, beside)), watched((0, 10), (40, 60)))
    assert headway[:4] == pytest.approx([NAN, 2.0, NAN, 2.5], nan_ok=True)
    assert np.isnan(headway[4:]).all()
    assert np.isnan(gap).all()


def test_a_long_vehicle_begins_its_headway_at_its_front() -> None:
    _, car = made_up(4, np.array([10.0]), 20.0)
    _, lorry = made_up(4, np.array([13.0]), 20.0, TRUCK, 16.5)
    headway, gap = headways_s(np.concatenate((car, lorry)), watched((0, 60)))
    assert headway[1] == pytest.approx(3.0 - (16.5 - 4.5) / 2 / 20.0)
    assert gap[1] == pytest.approx(headway[1] - 4.5 / 20.0)


def test_cutting_time_into_intervals_loses_no_vehicle_and_no_time_on_the_road() -> None:
    random = np.random.default_rng(5)
    made = traffic(
        made_up(4, np.sort(random.uniform(5, 895, 200)), 12.0), observed=watched((0, 900))
    )
    whole = row(measure(made, np.array([0, 900]) * NS), 0, 4)
    for step in (1, 20, 300):
        edges = np.arange(0, 901, step) * NS
        parts = measure(made, edges)
        parts = parts[(parts["lane_id"] == 4) & (parts["category"] == -1)]
        assert parts["volume"].sum() == whole["volume"]
        assert parts["density_veh_per_km"].mean() == pytest.approx(whole["density_veh_per_km"])


@pytest.mark.parametrize(
    ("scheme", "class_id", "length_m", "category"),
    [
        ("coco", TRUCK, 5.0, "truck"),
        ("coco", UNKNOWN_CLASS, NAN, "unknown"),
        ("fhwa3", CAR, 4.5, "short"),
        ("fhwa3", UNKNOWN_CLASS, 12.0, "medium"),
        ("fhwa3", TRUCK, 16.5, "long"),
        ("fhwa3", CAR, NAN, "short"),
        ("fhwa3", UNKNOWN_CLASS, NAN, "unknown"),
        ("tls5+1", MOTORCYCLE, 2.0, "car"),
        ("tls5+1", CAR, 9.0, "car_with_trailer"),
        ("tls5+1", TRUCK, 9.0, "lorry"),
        ("tls5+1", TRUCK, 16.5, "lorry_combination"),
        ("tls5+1", TRUCK, NAN, "lorry"),
        ("tls5+1", BUS, 12.0, "bus"),
        ("tls5+1", UNKNOWN_CLASS, 4.0, "unknown"),
    ],
)
def test_classes_of_the_schemes(scheme: str, class_id: int, length_m: float, category: str) -> None:
    found = SCHEMES[scheme].category_of(np.array([class_id]), np.array([length_m]))
    assert SCHEMES[scheme].categories[found[0]] == category


def test_a_scheme_of_ones_own_may_have_any_categories() -> None:
    content = SchemeFile.model_validate(
        {
            "rules": [
                {"category": "van", "classes": ["car"], "from_m": 5.2},
                {"category": "car", "classes": ["car", 3]},
            ],
            "heavy": ["van"],
        }
    )
    scheme = scheme_of(content, "own.yaml")
    found = scheme.category_of(
        np.array([CAR, CAR, MOTORCYCLE, BUS]), np.array([6.0, 4.0, NAN, 9.0])
    )
    assert [scheme.categories[k] for k in found] == ["van", "car", "car", "unknown"]
    assert scheme.is_heavy.tolist() == [True, False, False]
    wrong = SchemeFile.model_validate({"rules": [{"category": "a", "classes": ["spaceship"]}]})
    with pytest.raises(ParameterError, match="spaceship"):
        scheme_of(wrong, "own.yaml")
    with pytest.raises(ParameterError, match="heavy"):
        scheme_of(SchemeFile(rules=content.rules, heavy=["tank"]), "own.yaml")
