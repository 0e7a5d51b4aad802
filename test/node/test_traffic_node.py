"""The traffic node: intervals from topics or from the recorder's database, each once."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from made_traffic_days import (
    CLOCK,
    LANES,
    STOPPED_LANE,
    SUMMER_ENDS_NS,
    day,
    offline,
    with_events,
)
from probe import LIMIT_S, LOSSLESS, Probe
from std_msgs.msg import String

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.core.lanes import LaneMap
from geoorbit_ros.core.tables import Frames
from geoorbit_ros.lanes.geojson import dumps_lanes, parse_lane_file
from geoorbit_ros.nodes.recorder import RecorderNode
from geoorbit_ros.nodes.support.composition import Composition
from geoorbit_ros.nodes.support.qos import LATCHED
from geoorbit_ros.nodes.traffic import TrafficNode
from geoorbit_ros.storage.database.traffic import TrafficDatabase, TrafficReader
from geoorbit_ros.traffic.events import EventWatch
from geoorbit_ros.traffic.messages import EVENT_POINT_DTYPE, INTERVAL_POINT_DTYPE, point_table

DATUM = Datum(50.0, 8.0)
TEXT = dumps_lanes(LaneMap(SUMMER_ENDS_NS, tuple(LANES)), DATUM, camera_id="north")
ROAD = dumps_lanes(LaneMap(SUMMER_ENDS_NS, (*LANES, STOPPED_LANE)), DATUM, camera_id="north")
AS_READ = parse_lane_file(TEXT, "text").lane_map.lanes
GIVEN = LOSSLESS | {"interval_s": CLOCK.length_s, "timezone": CLOCK.zone}


def send_all(probe: Probe, frames: Frames) -> None:
    send = probe.table_publisher("tracks")
    for k, stamp_ns in enumerate(frames.stamp_ns.tolist()):
        send(stamp_ns, frames.frame(k))


def stored_until(path: Path) -> int:
    with TrafficReader(path) as reader:
        return max(content.end_ns for content in reader.cameras())


def wait_stored(probe: Probe, path: Path, last_ns: int) -> None:
    probe.until(lambda: stored_until(path) == last_ns, "all frames stored")


def wait_intervals(run: Composition, node: TrafficNode, count: int) -> None:
    run.wait(lambda: node.published.intervals == count, LIMIT_S, f"{count} intervals")


def expected(frames: Frames, until_ns: int) -> np.ndarray:
    _, rows = offline(frames, lanes=AS_READ)
    return point_table(rows[rows["start_ns"] < until_ns])


def test_intervals_of_topics_are_those_of_the_offline_way(nodes: Composition) -> None:
    frames = day(SUMMER_ENDS_NS, 4)
    node = nodes.make(TrafficNode, "north", GIVEN)
    probe = Probe(nodes)
    heard = probe.listen_tables("traffic/intervals", INTERVAL_POINT_DTYPE)
    texts = probe.listen("traffic/intervals_json", String)
    probe.publisher("lanes/geojson", String, LATCHED).publish(String(data=TEXT))
    send_all(probe, frames)
    probe.until(
        lambda: node.published.intervals == 3 and len(heard) == node.diagnostics.published, "three"
    )
    rows = np.concatenate([rows for _, _, rows in heard])
    until_ns = SUMMER_ENDS_NS + 180 * 10**9
    assert rows.tobytes() == expected(frames, until_ns).tobytes()
    end = '"interval_end": "2026-10-25T02:03:00+01:00"'
    probe.until(lambda: bool(texts) and end in texts[-1].data, "the text of the third")
    newest = json.loads(texts[-1].data)
    assert newest["camera_id"] == "north"
    assert {row["class"] for row in newest["rows"]} >= {"all", "car"}
    assert probe.status_of("/north/traffic")["intervals"] == "3"


def test_events_are_told_while_they_last(nodes: Composition) -> None:
    frames = with_events(day(SUMMER_ENDS_NS, 4), period_s=235)
    watch = EventWatch(parse_lane_file(ROAD, "text").lane_map.lanes)
    watch.add(frames)
    wanted = point_table(watch.take())
    nodes.make(TrafficNode, "north", GIVEN)
    probe = Probe(nodes)
    heard = probe.listen_tables("traffic/events", EVENT_POINT_DTYPE)
    texts = probe.listen("traffic/events_json", String)
    probe.publisher("lanes/geojson", String, LATCHED).publish(String(data=ROAD))
    meanwhile = int(np.searchsorted(frames.stamp_ns, SUMMER_ENDS_NS + 205 * 10**9))
    send_all(probe, frames.part(0, meanwhile))
    probe.until(lambda: bool(texts) and '"stopped_vehicle"' in texts[-1].data, "one that lasts")
    send_all(probe, frames.part(meanwhile, len(frames)))
    probe.until(lambda: sum(len(rows) for _, _, rows in heard) >= len(wanted), "all events")
    rows = np.concatenate([rows for _, _, rows in heard])
    assert rows.tobytes() == wanted.tobytes()
    probe.until(lambda: bool(texts) and '"events": []' in texts[-1].data, "the end of all")
    assert probe.status_of("/north/traffic")["events"] == "2"


def test_intervals_are_stored_beside_the_tracks_and_go_on_after_a_restart(
    nodes: Composition, tmp_path: Path
) -> None:
    frames, path = day(SUMMER_ENDS_NS, 5), tmp_path / "t.db"
    database = {"database": str(path)}
    recorder = nodes.make(RecorderNode, "north", LOSSLESS | database)
    probe = Probe(nodes)
    probe.publisher("lanes/geojson", String, LATCHED).publish(String(data=TEXT))
    probe.until(lambda: recorder.lane_maps == 1, "the lane map")
    half = int(np.searchsorted(frames.stamp_ns, SUMMER_ENDS_NS + 150 * 10**9))
    for part in (frames.part(0, half), frames.part(half, len(frames))):
        send_all(probe, part)
        wait_stored(probe, path, int(part.stamp_ns[-1]))
        with Composition(quiet=True) as run:  # it takes nothing from topics
            node = run.make(TrafficNode, "north", GIVEN | database)
            wait_intervals(run, node, 2)
    with TrafficReader(path) as reader:
        (series,) = reader.traffic_series()
        assert (series.intervals, series.start_ns) == (4, SUMMER_ENDS_NS)
        assert series.name.zone == CLOCK.zone
        assert reader.traffic_vehicle_count("north") > 0


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"timezone": "Mars/Base"}, ("'timezone'", "Mars/Base")),
        ({"class_scheme": "magic"}, ("'class_scheme'", "fhwa3")),
        ({"interval_s": 7}, ("7 s", "divides a day")),
        ({"calibration_file": "nowhere.csv"}, ("nowhere.csv",)),
    ],
)
def test_a_bad_start_is_one_sentence(
    nodes: Composition, given: dict[str, object], words: tuple[str, ...]
) -> None:
    with pytest.raises(GeoOrbitError) as caught:
        nodes.make(TrafficNode, "north", given)
    assert "\n" not in str(caught.value)
    assert all(word in str(caught.value) for word in words), str(caught.value)


def test_two_nodes_do_not_count_one_camera_into_one_database(
    nodes: Composition, tmp_path: Path
) -> None:
    given = {"database": str(tmp_path / "t.db")}
    TrafficDatabase(tmp_path / "t.db").close()
    nodes.make(TrafficNode, "north", given)
    nodes.make(TrafficNode, "south", given)
    with pytest.raises(GeoOrbitError, match="in use by"):
        nodes.make(TrafficNode, "north", given)
