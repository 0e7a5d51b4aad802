"""A killed camera goes on where it was: the same lanes, the same ids, no evidence twice."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.lanes import LaneMap
from geoorbit_ros.core.tables import TRACK_DTYPE
from geoorbit_ros.lanes.estimators.estimator import make_estimator
from geoorbit_ros.lanes.mapping.live_mapper import LaneMemory, LiveMapper
from geoorbit_ros.lanes.mapping.mapper import LaneMapper
from geoorbit_ros.lanes.parameters import LaneParameters

DATUM = Datum(43.0, -89.4)
FPS, SPEED_MPS, LENGTH_M = 10, 25.0, 150.0
LANES_M = (0.0, 3.6)
HEADWAY_S = 2.0
Frame = tuple[int, NDArray[np.void]]


def traffic(begin_s: float, end_s: float, first_ns: int = 10**9) -> Iterator[Frame]:
    """Two lanes eastwards, a vehicle every two seconds in each, for ever."""
    for k in range(round(begin_s * FPS), round(end_s * FPS)):
        time_s = k / FPS
        rows = []
        for lane, y_m in enumerate(LANES_M):
            start = HEADWAY_S * np.arange(int(time_s / HEADWAY_S) + 1) + 0.7 * lane
            for number, away_m in enumerate((time_s - start) * SPEED_MPS):
                if 0.0 <= away_m <= LENGTH_M:
                    wander = 0.15 * np.sin(number * 2.4)
                    row = np.zeros(1, TRACK_DTYPE)
                    row["x"], row["y"], row["vx"] = away_m, y_m + wander, SPEED_MPS
                    row["track_id"], row["class_id"] = 2 * number + lane + 1, 2
                    row["sigma"], row["score"] = 0.1, 0.9
                    rows.append(row)
        yield first_ns + round(time_s * 1e9), np.concatenate([np.zeros(0, TRACK_DTYPE), *rows])


def camera(file: Path | None, warnings: list[str], estimator: str = "curvilinear") -> LiveMapper:
    return LiveMapper(estimator, LaneParameters(), 5.0, file, warnings.append)


def fresh(estimator: str) -> LaneMapper:
    return LaneMapper(make_estimator(estimator))


def run(mapper: LiveMapper, frames: Iterator[Frame]) -> list[LaneMap]:
    maps = [mapper.add(stamp_ns, rows, DATUM) for stamp_ns, rows in frames]
    return [found for found in maps if found is not None]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "state" / "lanes.npz"


def ids(lane_map: LaneMap) -> dict[int, float]:
    """Where each lane is, by id."""
    return {lane.lane_id: round(lane.middle[1], 1) for lane in lane_map.lanes}


def test_the_first_frame_after_a_crash_brings_the_lanes_back(file: Path) -> None:
    warnings: list[str] = []
    before = run(camera(file, warnings), traffic(0.0, 60.0))[-1]
    after = run(camera(file, warnings), traffic(60.0, 60.2))
    assert len(after) == 1, "at once, not after an update period"
    assert [lane.status for lane in after[0].lanes] == ["confirmed", "confirmed"]
    assert ids(after[0]) == ids(before)
    for old, new in zip(before.lanes, after[0].lanes, strict=True):
        assert abs(new.vehicles - old.vehicles) <= 5, "at most ten seconds of traffic are lost"
    assert warnings == []


def test_a_crashed_camera_ends_with_the_map_of_one_that_was_never_killed(file: Path) -> None:
    whole = camera(None, [])
    run(whole, traffic(0.0, 120.0))
    run(camera(file, []), traffic(0.0, 60.0))
    killed = camera(file, [])
    run(killed, traffic(60.0, 120.0))
    expected, found = whole.finish(), killed.finish()
    assert ids(found) == ids(expected)
    for a, b in zip(expected.lanes, found.lanes, strict=True):
        assert b.vehicles == pytest.approx(a.vehicles, abs=6.0)
        assert b.vehicles <= a.vehicles + 0.5, "nothing is counted twice"


def test_a_recording_that_begins_again_after_the_crash_is_new_traffic(file: Path) -> None:
    run(camera(file, []), traffic(0.0, 60.0))
    again = camera(file, [])
    maps = run(again, traffic(0.0, 60.0))
    before = maps[0].lanes[0].vehicles
    assert again.finish().lanes[0].vehicles > before + 20
    assert all(np.isfinite(lane.vehicles) for lane in again.finish().lanes)


def test_both_estimators_keep_their_ids(file: Path) -> None:
    for name in ("curvilinear", "geolane"):
        place = file.with_name(f"{name}.npz")
        before = run(camera(place, [], name), traffic(0.0, 60.0))[-1]
        mapper = fresh(name)
        assert LaneMemory(place, name).resume(mapper, DATUM, 10**12)
        for stamp_ns, rows in traffic(60.0, 120.0):
            mapper.add(stamp_ns, rows)
        assert ids(mapper.finish()).keys() == ids(before).keys()


@pytest.mark.parametrize("damage", ["cut", "text", "other array", "empty"])
def test_a_broken_file_is_one_warning_and_lanes_start_anew(file: Path, damage: str) -> None:
    run(camera(file, []), traffic(0.0, 40.0))
    content = file.read_bytes()
    if damage == "other array":
        with file.open("wb") as stream:
            np.savez(stream, about=np.array(["format 2", "curvilinear", "43.0 -89.4"]))
    else:
        file.write_bytes({"cut": content[:-100], "text": b"lanes", "empty": b""}[damage])
    file.with_name("lanes.npz.previous").unlink()
    warnings: list[str] = []
    maps = run(camera(file, warnings), traffic(0.0, 6.0))
    assert len(warnings) == 1
    assert str(file) in warnings[0]
    assert len(maps) == 1, "the regular update, nothing found again"


def test_a_broken_file_costs_what_was_saved_last(file: Path) -> None:
    run(camera(file, []), traffic(0.0, 40.0))
    file.write_bytes(b"lanes")
    warnings: list[str] = []
    maps = run(camera(file, warnings), traffic(41.0, 42.0))
    assert maps[0].lanes, "those of the save before"
    assert len(warnings) == 1
    assert "lanes.npz.damaged" in warnings[0]
    assert "pickle" not in warnings[0]


def test_memory_of_another_method_or_place_is_refused(file: Path) -> None:
    run(camera(file, []), traffic(0.0, 20.0))
    with pytest.raises(InputFileError, match="'curvilinear', expected 'geolane'"):
        LaneMemory(file, "geolane").resume(fresh("geolane"), DATUM, 0)
    elsewhere = Datum(43.1, -89.4)
    with pytest.raises(InputFileError, match=r"43\.1"):
        LaneMemory(file, "curvilinear").resume(fresh("curvilinear"), elsewhere, 0)


def test_memory_of_an_older_format_is_refused_in_one_sentence(file: Path) -> None:
    run(camera(file, []), traffic(0.0, 20.0))
    with np.load(file) as content:
        older = dict(content) | {"about": np.array(["1", "curvilinear", "43.0 -89.4"])}
    with file.open("wb") as stream:
        np.savez(stream, **older)
    warnings: list[str] = []
    run(camera(file, warnings), traffic(20.0, 21.0))
    assert len(warnings) == 1
    assert "'1', expected 'format 2'" in warnings[0]


def test_a_place_that_can_not_be_written_is_one_warning(tmp_path: Path) -> None:
    (tmp_path / "state").write_text("a file where the folder should be")
    warnings: list[str] = []
    run(camera(tmp_path / "state" / "lanes.npz", warnings), traffic(0.0, 6.0))
    assert len(warnings) == 1
    assert "not remembered" in warnings[0]
