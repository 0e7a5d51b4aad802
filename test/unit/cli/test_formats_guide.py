"""The examples in docs/formats.md are files that the readers take."""

from __future__ import annotations

import json
import re
from pathlib import Path

from geoorbit_ros.calibration.control_point_file import read_control_points
from geoorbit_ros.lanes.geojson import lanes_to_geojson, read_lane_file
from geoorbit_ros.storage.track_csv import read_track_csv

GUIDE = Path(__file__).parents[3] / "docs" / "formats.md"


def example(section: str, folder: Path) -> Path:
    """The first code block of a section, as a file of the section's name."""
    text = GUIDE.read_text(encoding="utf-8").split(f"\n## {section}\n")[1]
    block = re.search(r"```\w+\n(.*?)```", text, re.DOTALL)
    assert block
    path = folder / section
    path.write_text(block.group(1), encoding="utf-8")
    return path


def test_tracks(tmp_path: Path) -> None:
    frames = read_track_csv(example("tracks.csv", tmp_path), (1920, 1080))
    assert (len(frames), len(frames.rows)) == (2, 3)


def test_calibration(tmp_path: Path) -> None:
    assert len(read_control_points(example("calibration.csv", tmp_path))) == 4


def test_lanes(tmp_path: Path) -> None:
    path = example("lanes.geojson", tmp_path)
    file = read_lane_file(path)
    assert (file.camera_id, file.lane_map.lanes[0].vehicles) == ("yahara", 17.0)
    assert len(file.lane_map.visible_m) == 3
    shown = json.loads(path.read_text(encoding="utf-8"))
    written = lanes_to_geojson(file.lane_map, file.datum)
    assert shown["geoorbit"].keys() == written["geoorbit"].keys()
    assert shown["features"][0].keys() == written["features"][0].keys()
    properties = [f["features"][0]["properties"].keys() for f in (shown, written)]
    assert properties[0] == properties[1]
    text = GUIDE.read_text(encoding="utf-8")
    assert all(f"| `{key}` |" in text for key in properties[1])


def test_truth(tmp_path: Path) -> None:
    (lane,) = read_lane_file(example("truth.geojson", tmp_path)).lane_map.lanes
    assert (lane.lane_id, lane.status) == (1, "confirmed")
