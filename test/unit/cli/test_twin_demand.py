"""`geoorbit twin demand`: one day out of a database of several."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
import pytest
from made_lane_traffic import Stream, straight, traffic
from made_twin import DATUM, made_network

from geoorbit_ros.cli.main import main
from geoorbit_ros.core.lanes import LaneMap, lane_of_map
from geoorbit_ros.core.polylines import offset_line
from geoorbit_ros.lanes.geojson import dumps_lanes
from geoorbit_ros.storage.database.writer import TrajectoryDatabase

DAY_NS = 86_400 * 10**9
MONDAY_NS = 1_777_852_800 * 10**9  # 2026-05-04 00:00 UTC
HOUR_NS = 3600 * 10**9
LANE_Y = -5.25  # the middle lane of `east`
SEEN_M = (120.0, 260.0)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network, and two minutes of traffic at 6:00 of two days, more on the second."""
    folder = tmp_path_factory.mktemp("demand")
    made_network(folder)
    line = np.column_stack((np.arange(*SEEN_M, 2.0), np.full(70, LANE_Y)))
    lane = lane_of_map(1, line, offset_line(line, 1.75), offset_line(line, -1.75))
    text = dumps_lanes(LaneMap(MONDAY_NS, (lane,)), DATUM, camera_id="north", estimator="made")
    with TrajectoryDatabase(folder / "tracks.db") as database:
        for day, vehicles in enumerate((40, 80)):
            begin_ns = MONDAY_NS + day * DAY_NS + 6 * HOUR_NS
            stream = Stream(straight(offset_m=LANE_Y), vehicles, *SEEN_M)
            frames = traffic([stream], duration_s=120.0)
            for k, stamp_ns in enumerate(frames.stamp_ns.tolist()):
                database.append("north", begin_ns + stamp_ns, frames.frame(k))
        database.append_lanes("north", MONDAY_NS + 6 * HOUR_NS, text)
    return folder


def demand(place: Path, out: Path, *options: str) -> int:
    words = ["twin", "demand", str(place / "tracks.db"), "--net", str(place / "scene.net.xml")]
    words += ["--interval", "1min", "--timezone", "UTC", "--out", str(out)]
    return main([*words, *options])


def flows(out: Path) -> list[dict[str, str]]:
    return [flow.attrib for flow in Xml.parse(out / "demand.rou.xml").iter("flow")]


@pytest.mark.parametrize(
    ("options", "vehicles"),
    [(("--day", "2026-05-04"), 40), ((), 80), (("--day", "2026-05-05"), 80)],
)
def test_the_day_that_is_asked_for(
    place: Path, tmp_path: Path, options: tuple[str, ...], vehicles: int
) -> None:
    assert demand(place, tmp_path / "day", *options) == 0
    found = flows(tmp_path / "day")
    assert sum(int(flow["number"]) for flow in found) == pytest.approx(vehicles, rel=0.1)
    assert {flow["departLane"] for flow in found} == {"1"}
    assert min(float(flow["begin"]) for flow in found) == pytest.approx(6 * 3600.0, abs=60.0)
    assert float(found[0]["departPos"]) == pytest.approx(SEEN_M[0], abs=1.5)


def test_a_day_without_data_is_refused(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert demand(place, tmp_path / "day", "--day", "2026-05-09") != 0
    said = " ".join(capsys.readouterr().err.split())
    assert "a day from 2026-05-04 to 2026-05-05" in said
    assert not (tmp_path / "day").exists()


def test_a_word_that_is_no_date_is_refused(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert demand(place, tmp_path / "day", "--day", "monday") != 0
    assert "a date: 2026-05-04" in " ".join(capsys.readouterr().err.split())
