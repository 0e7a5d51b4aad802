"""Scene files: what ships, and one sentence for everything that is wrong in one."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from made_scenes import camera_of, true_lanes

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.resources import share_path
from geoorbit_ros.scenes.scene import Scene, load_scene, road_length_m, shipped_scenes

REQUIRED = ("straight", "curve", "s_curve", "on_ramp", "off_ramp", "lane_drop", "urban", "night")


def text_of(name: str) -> str:
    return share_path(f"params/scenes/{name}.yaml").read_text(encoding="utf-8")


def test_the_scenes_that_people_need_are_there() -> None:
    for word in REQUIRED:
        assert any(word in name for name in shipped_scenes()), word


@pytest.mark.parametrize("name", shipped_scenes())
def test_a_shipped_scene_is_called_as_its_file_and_shows_lanes(name: str) -> None:
    scene = load_scene(name)
    assert scene.name == name
    assert scene == load_scene(share_path(f"params/scenes/{name}.yaml"))
    assert len(true_lanes(scene)) >= 2


@pytest.mark.parametrize("name", shipped_scenes())
def test_every_point_of_the_truth_is_in_the_image(name: str) -> None:
    scene = load_scene(name)
    camera = camera_of(scene)
    for lane in true_lanes(scene):
        pixel, depth = camera.project(np.pad(lane.centerline_m, ((0, 0), (0, 1))))
        assert np.all(depth > 0.0)
        assert np.all((pixel >= 0.0) & (pixel <= camera.image_size))


def test_headings_are_spread_round_the_compass_and_off_its_axes() -> None:
    headings = np.array([true_lanes(load_scene(name))[0].heading_deg for name in shipped_scenes()])
    off_axis = np.abs((headings + 45.0) % 90.0 - 45.0)
    # A method that needs x = f(y), or the reverse, must not be right by luck.
    assert np.sum(off_axis > 10.0) >= 8
    assert np.all(off_axis > 5.0)
    gaps = np.diff(np.append(np.sort(headings), headings.min() + 360.0))
    assert gaps.max() < 90.0


@pytest.mark.parametrize("name", shipped_scenes())
def test_the_length_that_positions_are_checked_against_is_the_roads(name: str) -> None:
    from geoorbit_ros.scenes.roads import place_roads

    scene = load_scene(name)
    known = {road.id: road for road in scene.roads}
    for road, placed in place_roads(scene).items():
        length = np.hypot(*np.diff(placed.border_m, axis=0).T).sum()
        assert road_length_m(known[road], known) == pytest.approx(length, rel=1e-3)


@pytest.mark.parametrize(
    ("name", "old", "new", "sentence"),
    [
        ("straight_3x3", "height_m: 12", "height_m: 1", "key 'camera.height_m': found 1, "),
        ("straight_3x3", "height_m: 12", "heigth_m: 9", "'camera.heigth_m': found an unknown key"),
        ("straight_3x3", "height_m: 12", "heigth_m: 9", "expected 'height_m'?"),
        ("straight_3x3", "fps: 15", "fps: .inf", "found inf, expected a finite number"),
        ("straight_3x3", "fps: 15", "fps: fast", "found 'fast', expected a finite number"),
        ("straight_3x3", "lanes: 3", "lanes: three", "'roads[0].lanes': found 'three', expected a"),
        ("straight_3x3", "straight_m: 600", "straight_m: -600", "'roads[0].path[0].straight_m'"),
        ("straight_3x3", "{straight_m: 600}", "600", "found 600, expected '{straight_m: …}' or "),
        ("straight_3x3", "{straight_m: 600}", "{radius_m: 600}", "path[0].turn_deg': found noth"),
        ("straight_3x3", "straight_m: 600", "radius_m: 600, turn_deg: 0", "at least 1 m of arc"),
        ("straight_3x3", "path: [{straight_m: 600}]", "path: []", "path': found 0 pieces"),
        ("straight_3x3", "opposite: {road: north", "opposite: {road: up", "found 'up', expected o"),
        ("straight_3x3", "id: south", "id: north", "'roads[1].id': found 'north' again"),
        ("straight_3x3", "route: [south]", "route: [east]", "flows[1].route[0]': found 'east'"),
        ("straight_3x3", "route: [south]", "route: [north, south]", "begins where 'north' ends"),
        ("straight_3x3", "hour: 2700", "hour: 9, lane_shares: [1, 1]", "3 shares, one per lane"),
        ("straight_3x3", "hour: 2700", "hour: 9, lane_shares: [0, 0, 0]", "not all 0"),
        ("straight_3x3", "hour: 2700", "hour: 9, arrival_lane: 3", "found 3, expected 0 to 2 on"),
        ("straight_3x3", "hour: 2700", "hour: 0", "found 0, expected greater than 0"),
        ("straight_3x3", "along_m: 262", "along_m: 900", "found 900, expected 0 to 600.0, the end"),
        ("straight_3x3", "pole: {road: north", "pole: {road: top", "'camera.pole.road': found 't"),
        ("straight_3x3", "along_m: 262, right_m: 3", "along_m: 200, right_m: 24", "place of the p"),
        ("straight_3x3", "1920, 1080", "10, 1080", "'camera.image_size[0]': found 10"),
        ("straight_3x3", "name: straight_3x3", "name: 3 lanes", "key 'name': found '3 lanes'"),
        ("straight_3x3", "name: straight_3x3", "", "key 'name': found nothing"),
        ("night_sparse", "miss_rate: 0.12", "miss_rate: 12", "'detector.miss_rate': found 12"),
        ("urban_turn", "bus: 0.04", "tram: 0.04", "key 'traffic.mix.tram': found an unknown type"),
        ("urban_turn", "radius_m: 12", "radius_m: 2", "found 2, expected more than the 3.2 m of"),
        ("curve_250m", "radius_m: 250", "radius_m: 9", "more than the 11 m of road inside"),
        ("on_ramp_merge", "follows: main_in", "follows: main_out", "merge → main_out → merge"),
        ("on_ramp_merge", "lane: 0}", "lane: 4}", "joins.lane': found 4, expected lane 0 to 3"),
        ("on_ramp_merge", "joins:", "follows: merge\n    joins:", "found follows and joins"),
    ],
)
def test_a_wrong_value_is_named_with_file_line_and_key(
    name: str, old: str, new: str, sentence: str, tmp_path: Path
) -> None:
    file = tmp_path / "scene.yaml"
    text = text_of(name)
    assert old in text
    file.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(InputFileError) as error:
        load_scene(file)
    message = str(error.value)
    assert sentence in message
    assert "\n" not in message
    match = re.match(rf"{re.escape(str(file))}, line (\d+), key '", message)
    assert match
    # The line is the one that was changed, or its neighbour where something is missing or doubled.
    line = text[: text.index(old)].count("\n") + 1
    if "circle" not in message and "again" not in message:
        assert abs(int(match[1]) - line) <= (1 if new and "\n" not in new else 3), message


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"", "found an empty file"),
        (b"- a\n- b\n", "found a list, expected a scene file in YAML: keys with values"),
        (b"name: x\nroads: [\n", "line 3: found broken YAML ("),
        (b"name: x\n\troads: 1\n", "line 2: found a tab in the indentation"),
        (b"\xff\xfe\x00", "found no text in utf-8"),
    ],
)
def test_what_is_no_scene_is_refused(content: bytes, sentence: str, tmp_path: Path) -> None:
    file = tmp_path / "scene.yaml"
    file.write_bytes(content)
    with pytest.raises(InputFileError, match=re.escape(sentence)) as error:
        load_scene(file)
    assert str(error.value).startswith(str(file))


def test_an_unknown_name_and_a_missing_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputFileError, match=r"'nowhere': found no such scene.*lane_drop"):
        load_scene("nowhere")
    with pytest.raises(InputFileError, match=r"nowhere\.yaml: found no such file"):
        load_scene(tmp_path / "nowhere.yaml")
    with pytest.raises(InputFileError, match="directory"):
        load_scene(tmp_path)


def test_a_file_of_ones_own_is_read_whatever_it_is_called(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine").write_text("\ufeff" + text_of("s_curve"), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    assert isinstance(load_scene("mine"), Scene)
