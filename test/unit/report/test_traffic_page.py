"""The traffic report: every lane in every picture, true numbers, outages are no zeros."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import pytest
from made_traffic_content import (
    BEGIN_NS,
    LANE_IDS,
    LENGTH_M,
    content_of,
    evenly,
    road,
    traffic_of,
)
from numpy.typing import NDArray
from page_checker import check_page

from geoorbit_ros.report.svg import Canvas
from geoorbit_ros.report.traffic.axes import Panel, limits, spread, time_ticks, value_ticks
from geoorbit_ros.report.traffic.content import (
    MANY_STEPS,
    MOST_TRACKS,
    TrafficContent,
    busiest_window,
    steps_of,
)
from geoorbit_ros.report.traffic.diagrams import headways, speed_flow
from geoorbit_ros.report.traffic.over_time import over_time
from geoorbit_ros.report.traffic.page import NO_VEHICLE, traffic_html
from geoorbit_ros.report.traffic.speed_map import lane_cells, speed_map
from geoorbit_ros.report.traffic.speed_scale import speed_scale
from geoorbit_ros.report.traffic.time_space import time_space
from geoorbit_ros.traffic.interval_clock import NS, IntervalClock
from geoorbit_ros.traffic.records import NO_LANE
from geoorbit_ros.traffic.stations import Station

SPEEDS_MPS = (20.0, 30.0, 25.0, 35.0)
HOUR_S = 3600.0
OUTAGE_S = (1.25 * HOUR_S, 2.1 * HOUR_S)


@pytest.fixture(scope="module")
def content() -> TrafficContent:
    """Four hours with an outage; the first lane is empty for the first hour."""
    starts = [evenly(20.0 + 5.0 * k, 4 * HOUR_S, seed=k) for k in range(4)]
    starts = [t[(t < OUTAGE_S[0] - 20.0) | (t > OUTAGE_S[1])] for t in starts]
    starts[0] = starts[0][starts[0] > HOUR_S]
    return content_of(traffic_of(starts, SPEEDS_MPS))


@pytest.fixture(scope="module")
def page(content: TrafficContent) -> str:
    return traffic_html(content, [("Tracks", "day <1>.csv")])


def shapes(markup: str, css: str) -> list[tuple[NDArray[np.float64], str]]:
    """Points of each SVG path of a class, and its tip."""
    found = re.findall(rf'<path d="([^"]*)" class="{css}"(?:/>|><title>([^<]*)</title>)', markup)
    return [
        (np.array(re.findall(r"-?\d+\.\d", data), float).reshape(-1, 2), tip) for data, tip in found
    ]


def test_the_page_is_well_formed_and_needs_nothing_else(page: str) -> None:
    checker = check_page(page)
    assert page.count("<svg") == page.count('role="img"')
    assert page.count('role="img"><title>') == page.count("<svg")
    headers = [dict([pair])["scope"] for pair in checker.attributes if pair[0] == "scope"]
    assert page.count("<th ") == len(headers)
    assert "day &lt;1&gt;.csv" in page


def test_the_same_traffic_gives_the_same_page(content: TrafficContent, page: str) -> None:
    assert traffic_html(content, [("Tracks", "day <1>.csv")]) == page


def time_space_of(content: TrafficContent, station: Station) -> Canvas:
    return time_space(content, station, speed_scale(3.6 * content.tracks["speed_mps"]))


@pytest.mark.parametrize("draw", [over_time, speed_flow, headways, time_space_of])
def test_every_lane_is_in_every_picture_of_its_station(
    content: TrafficContent, draw: Callable[[TrafficContent, Station], Canvas]
) -> None:
    shown = list[int]()
    for station in content.stations:
        markup = draw(content, station).markup()
        shown += {int(k) for k in re.findall(r">lane (\d+)[:<]", markup)}
    assert sorted(shown) == sorted(LANE_IDS)


def test_every_lane_and_station_is_on_the_map(content: TrafficContent) -> None:
    canvas, _ = speed_map(content, speed_scale(3.6 * content.tracks["speed_mps"]))
    markup = canvas.markup()
    for lane_id in LANE_IDS:
        assert markup.count(f'text-anchor="middle">{lane_id}</text>') == 1
    for station in content.stations:
        assert markup.count(f">station {station.station_id}</text>") == 1


def test_numbers_in_the_page_are_those_of_the_tables(content: TrafficContent, page: str) -> None:
    table = page[page.index("Traffic per lane") : page.index("Where it was counted")]
    rows = re.findall(r'<th scope="row">(.*?)</th>(.*?)</tr>', table)
    order = [k for s in content.stations for k in (*content.lane_ids(s), NO_LANE)]
    assert len(rows) == len(order)
    stations = [s for s in content.stations for _ in (*content.lane_ids(s), NO_LANE)]
    for (name, cells), lane_id, station in zip(rows, order, stations, strict=True):
        row = content.whole_row(station, lane_id)
        values = re.findall(r"<td[^>]*>([^<]*)</td>", cells)
        assert name == "All lanes" if lane_id == NO_LANE else f">{lane_id}<" in name
        assert int(values[1].split(" ")[0].replace(",", "")) == row["volume"]
        assert float(values[2].replace(",", "")) == pytest.approx(row["flow_veh_per_h"], abs=0.5)
        mean, sigma = map(float, values[3].split(" ± "))
        assert mean == pytest.approx(row["time_mean_speed_kmh"], abs=0.051)
        assert sigma == pytest.approx(row["time_mean_speed_sigma_kmh"], abs=0.051)
        assert float(values[4]) == pytest.approx(row["speed_p85_kmh"], abs=0.051)
        assert float(values[7]) == pytest.approx(100 * row["heavy_share"], abs=0.51)
        steps = content.rows_of(content.steps, station, lane_id)
        assert steps["volume"].sum() == row["volume"], "the picture shows all vehicles"
    counted = sum(int(content.whole_row(s)["volume"]) for s in content.stations)
    assert f"<b>{counted:,}</b><span>vehicles counted" in page


def test_time_in_which_nobody_watched_is_hatched_and_has_no_line(content: TrafficContent) -> None:
    for station in content.stations:
        markup = over_time(content, station).markup()
        rects = re.findall(r'<rect x="([\d.]+)" y="[\d.]+" width="([\d.]+)"[^>]*unwatched', markup)
        assert len(rects) == 2, "one in each of the two diagrams"
        left = float(rects[0][0])
        right = left + float(rects[0][1])
        first, last = 64.0, 1040.0 - 76.0
        share = (last - first) / content.duration_s
        assert left <= first + share * OUTAGE_S[0] + 2.0
        assert right >= first + share * (OUTAGE_S[1] - 30.0)
        lines = shapes(markup, r"series l\d")
        assert len(lines) == 2 * len(content.lane_ids(station))
        quarter = 900.0 * share
        for points, _ in lines:
            inside = (points[:, 0] > left + quarter) & (points[:, 0] < right - quarter)
            assert not inside.any()


def test_an_empty_road_that_was_watched_is_zero_and_not_hatched(content: TrafficContent) -> None:
    station = next(s for s in content.stations if LANE_IDS[0] in content.lane_ids(s))
    markup = over_time(content, station).markup()
    lines = [
        points for points, tip in shapes(markup, r"series l\d") if tip == f"Lane {LANE_IDS[0]}"
    ]
    flow, speed = lines
    zero = flow[:, 1].max()
    empty = flow[:, 0] < 64.0 + 0.2 * 900.0
    assert np.all(flow[empty, 1] == zero)
    assert empty.sum() >= 4
    assert speed[:, 0].min() > 64.0 + 0.2 * 900.0, "nobody drove at a speed there"


def test_lines_of_vehicles_are_as_steep_as_they_are_fast(content: TrafficContent) -> None:
    scale = speed_scale(3.6 * content.tracks["speed_mps"])
    window_s = (content.window_ns[1] - content.window_ns[0]) / NS
    for station in content.stations:
        markup = time_space(content, station, scale).markup()
        panels = markup.split("<clipPath")[1:]
        for lane_id, panel in zip(content.lane_ids(station), panels, strict=True):
            speed = SPEEDS_MPS[LANE_IDS.index(lane_id)]
            kind = scale.css(int(scale.class_of(np.array([3.6 * speed]))[0]))
            drawn = re.findall(r'<path d="([^"]*)" class="track (s\d)"', panel)
            assert [css for _, css in drawn] == [kind], "all of a lane drive at one speed"
            for line in drawn[0][0].split("M")[1:]:
                x, y = np.array(line.split(), float).reshape(-1, 2)[[0, -1]].T
                time_s = (x[1] - x[0]) / 900.0 * window_s
                way_m = (y[0] - y[1]) / 140.0 * LENGTH_M
                assert way_m == pytest.approx(speed * time_s, abs=0.2 * speed + 2.0)


def test_each_piece_of_a_lane_has_the_speed_that_was_driven(content: TrafficContent) -> None:
    for lane, speed in zip(road(), SPEEDS_MPS, strict=True):
        cells = list(lane_cells(lane, content.tracks))
        assert len(cells) == 12
        assert [kmh for _, kmh in cells] == pytest.approx([3.6 * speed] * 12, rel=0.02)
        outline = np.vstack([points for points, _ in cells])
        assert np.ptp(outline[:, 0]) == pytest.approx(LENGTH_M)


def test_a_lane_on_which_nobody_drove_has_no_speed() -> None:
    content = content_of(traffic_of([evenly(15.0, 300.0), *[np.empty(0)] * 3], SPEEDS_MPS))
    assert all(np.isnan(kmh) for _, kmh in lane_cells(road()[1], content.tracks))
    page = traffic_html(content, [])
    check_page(page)
    assert page.count(NO_VEHICLE) == 5  # in all pictures and the classes, for the other direction
    assert "No vehicle crossed station 2 (towards W)" in page


def test_one_vehicle_gives_a_page() -> None:
    content = content_of(traffic_of([np.array([3.0]), *[np.empty(0)] * 3], SPEEDS_MPS))
    page = traffic_html(content, [])
    check_page(page)
    assert "1 vehicle drove towards E" in page
    assert "nan" not in page


def test_a_busy_day_is_a_small_page() -> None:
    starts = [evenly(9.0, 86_400.0, seed=k) for k in range(4)]
    content = content_of(traffic_of(starts, SPEEDS_MPS), interval_s=60)
    page = traffic_html(content, [])
    assert content.step_clock.length_s == 300
    assert len(content.tracks["run"]) > 1000
    assert "the busiest" in page
    assert len(page.encode()) < 1_500_000


def test_the_window_has_most_vehicles_of_all_of_its_length() -> None:
    random = np.random.default_rng(3)
    stamps = np.sort(np.append(random.integers(0, 9000, 900), random.integers(5000, 5600, 250)))
    first, last = busiest_window(stamps * NS, 0, 9000 * NS)

    def count(begin: int) -> int:
        return int(((stamps * NS >= begin) & (stamps * NS <= begin + last - first)).sum())

    assert 60 * NS < last - first < 9000 * NS
    assert count(first) <= MOST_TRACKS
    assert count(first) == max(
        count(int(t) * NS) for t in stamps if t * NS + last - first <= 9000 * NS
    )
    assert busiest_window(stamps[:50] * NS, 0, 9000 * NS) == (0, 9000 * NS)


@pytest.mark.parametrize("length_s", [1, 7, 60, 300, 3600, 86_400, 30 * 86_400])
@pytest.mark.parametrize("interval_s", [1, 60, 900, 86_400])
def test_steps_are_few_enough_to_be_seen_and_divide_a_day(length_s: int, interval_s: int) -> None:
    steps = steps_of(IntervalClock(interval_s, "UTC"), BEGIN_NS, BEGIN_NS + length_s * NS)
    assert length_s / steps.length_s <= MANY_STEPS
    assert 86_400 % steps.length_s == 0
    if 4 <= length_s / interval_s <= MANY_STEPS:
        assert steps.length_s == interval_s


@pytest.mark.parametrize("hours", [0.01, 0.3, 5.0, 30.0, 200.0])
def test_ticks_stand_on_the_local_clock_also_where_it_is_changed(hours: float) -> None:
    first_ns = 1_792_875_600 * NS  # 25 October 2026, 01:00 in Berlin; at 3 the clock goes back
    ticks, label = time_ticks(first_ns, first_ns + round(hours * 3600 * NS), "Europe/Berlin")
    at = np.array([t for t, _ in ticks])
    assert 2 <= len(ticks) <= 12
    assert np.all(np.diff(at) > 0)
    assert "Europe/Berlin" in label
    if hours >= 5.0:
        assert all(re.fullmatch(r"\d\d:00|\d+ \w+", text) for _, text in ticks)


def test_an_axis_holds_its_values_and_begins_at_zero_when_told() -> None:
    random = np.random.default_rng(0)
    for _ in range(50):
        values = random.uniform(0.0, 10.0 ** random.uniform(-1, 4), 20)
        low, high = limits(values)
        assert low == 0.0
        assert high >= values.max()
        ticks = [v for v, _ in value_ticks(low, high)]
        assert ticks[-1] == pytest.approx(high)
        assert 2 <= len(ticks) <= 12
    assert limits(np.array([90.0, 110.0]), from_zero=False)[0] > 0.0
    assert limits(np.array([np.nan])) == (0.0, 5.0)


def test_labels_do_not_lie_upon_one_another() -> None:
    places = np.sort(spread([5.0, 6.0, 6.0, 40.0, 99.0, 99.0], 10.0, 0.0, 100.0))
    assert np.all(np.diff(places) >= 10.0 - 1e-9)
    assert places[0] >= 0.0
    assert places[-1] <= 100.0


def test_a_panel_puts_its_corners_where_they_belong() -> None:
    panel = Panel(10.0, 20.0, 100.0, 50.0, (0.0, 4.0), (30.0, 40.0))
    pixel = panel.to_pixel(np.array([0.0, 4.0]), np.array([30.0, 40.0]))
    assert pixel.tolist() == [[10.0, 70.0], [110.0, 20.0]]


def test_colours_of_speeds_go_from_slow_to_fast_and_do_not_flicker() -> None:
    random = np.random.default_rng(1)
    for spread_kmh in (1.0, 20.0, 90.0):
        scale = speed_scale(random.normal(95.0, spread_kmh, 500))
        assert 1 <= len(scale.bound_kmh) <= 5
        assert len(scale.texts()) == len(scale.bound_kmh) + 1
        classes = [scale.css(k) for k in range(len(scale.bound_kmh) + 1)]
        assert classes == sorted(set(classes))
        bound = float(scale.bound_kmh[0])
        noisy = bound + random.uniform(-1.0, 1.0, 50)
        assert len(set(scale.steady_class_of(noisy).tolist())) == 1
