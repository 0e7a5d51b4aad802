"""A calibration without a place is laid on a map, or the places that fit are named."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from made_scenes import camera_of, run_of
from numpy.typing import NDArray

from geoorbit_ros.calibration.camera_facts import CameraFacts
from geoorbit_ros.calibration.control_point_file import read_control_points
from geoorbit_ros.calibration.control_point_writer import write_control_points
from geoorbit_ros.calibration.control_points import ControlPoints
from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.cli.main import main
from geoorbit_ros.cli.place_on_map import Whereabouts, parse_compass, place_on_map
from geoorbit_ros.roadnet.network import load_network
from geoorbit_ros.scenes.network import write_network
from geoorbit_ros.scenes.roads import place_roads
from geoorbit_ros.scenes.scene import load_scene

Array = NDArray[np.float64]
SECONDS, SCALE = 30.0, 1.02
BEND, STRAIGHT = "s_curve", "straight_3x3"


def foot_m(name: str) -> Array:
    """Where the pole stands in the scene's frame."""
    return np.asarray(camera_of(load_scene(name)).centre_m[:2])


def unplaced(name: str) -> tuple[ControlPoints, float]:
    """Points as traffic alone gives them, y ahead of the camera, and where it looks, degrees."""
    points = run_of(name, duration_s=SECONDS).control_points
    ahead = points.local_m.mean(axis=0) - foot_m(name)
    looks = float(np.arctan2(ahead[0], ahead[1]))
    cos, sin = np.cos(looks), np.sin(looks)
    own = SCALE * (points.local_m - foot_m(name)) @ np.array([[cos, sin], [-sin, cos]])
    facts = CameraFacts(run_of(name, duration_s=SECONDS).image_size, None, 0.03, north_known=False)
    return replace(points, local_m=own, datum=None, facts=facts), np.degrees(looks) % 360.0


def moved(name: str, east_m: float, north_m: float) -> Datum:
    """The place of the pole, wrong by so much."""
    datum = run_of(name, duration_s=SECONDS).datum
    at = datum.to_geodetic(foot_m(name)[None] + np.array([[east_m, north_m]]))[0]
    return Datum(float(at[0]), float(at[1]))


@cache
def placed(
    name: str, east_m: float, north_m: float, sigma_m: float, with_looks: bool
) -> tuple[ControlPoints, ControlPoints, str]:
    """Points before and after, and what is said."""
    run = run_of(name, duration_s=SECONDS)
    points, looks_deg = unplaced(name)
    near = moved(name, east_m, north_m)
    with TemporaryDirectory() as folder:
        network = write_network(place_roads(load_scene(name)), Path(folder), run.datum)
        where = Whereabouts(
            load_network(network, near), near, sigma_m, looks_deg if with_looks else None
        )
        found, said = place_on_map(points, run.frames, run.image_size, where)
    return points, found, "\n".join(said)


def test_a_road_with_a_bend_is_placed_where_it_is(tmp_path: Path) -> None:
    run = run_of(BEND, duration_s=SECONDS)
    _, found, said = placed(BEND, 16.0, -12.0, 25.0, True)
    write_control_points(tmp_path / "calibration.csv", found)
    read = read_control_points(tmp_path / "calibration.csv", run.datum, image_size=run.image_size)
    error = fit_homography(read).to_ground(run.control_points.pixel) - run.control_points.local_m
    assert np.hypot(*error.T).max() < 5.0
    assert np.median(np.hypot(*error.T)) < 3.0
    assert "(clockwise from north)" in said
    assert read.facts.north_known
    assert found.facts.scale_sigma < 0.03, "a bend tells the scale"


def test_a_straight_road_seen_from_either_end_is_left_where_it_is_and_both_are_named() -> None:
    points, found, said = placed(STRAIGHT, 0.0, 0.0, 50.0, False)
    assert found is points
    assert not found.facts.north_known
    named = [line for line in said.split("\n") if "%: the camera at" in line.lower()]
    assert len(named) >= 2
    turns = [float(line.split("looking to ")[1].rstrip("°.")) for line in named]
    assert max(abs((a - turns[0] + 180.0) % 360.0 - 180.0) for a in turns) > 150.0
    assert "--looks" in said
    assert "the file has none of these places" in said.lower()


def test_a_place_far_from_the_given_one_is_doubted() -> None:
    assert "Is it this road" not in placed(BEND, 16.0, -12.0, 25.0, True)[2]
    said = placed(BEND, 16.0, -12.0, 7.0, True)[2]
    assert "m from --near" in said
    assert "± 7 m: is it this road" in said


@pytest.mark.parametrize(("text", "degrees"), [("n", 0.0), ("SW", 225.0), ("-90", 270.0)])
def test_directions_are_those_of_a_compass(text: str, degrees: float) -> None:
    assert parse_compass(text) == degrees


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--looks", "N"], "option --looks: found N, expected a map, too: --map"),
        (["--near-sigma", "2"], "option --near-sigma: found 2, expected a map, too: --map"),
        (["--map", "m.xml"], "option --map: found no --near, expected --near LAT,LON"),
        (["--map", "m.xml", "--near", "43,-89", "--looks", "up"], "option --looks: found 'up'"),
        (["--map", "m.xml", "--near", "43,-89", "--points", "p.csv"], "--points, too"),
        (["--near", "here"], "option --near: found 'here', expected LATITUDE,LONGITUDE"),
    ],
)
def test_options_that_contradict_are_refused_in_one_sentence(
    options: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "calibration.csv"
    assert main(["calibrate", "--tracks", "t.csv", "--out", str(out), *options]) == 2
    assert said in " ".join(capsys.readouterr().err.split())
    assert not out.exists()
