"""Laws of the images: same bits, marks on the lanes, light as it should be."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from made_images import (
    CAR,
    TRUCK,
    VAN,
    difference,
    nothing,
    on_road,
    renderer,
    road_and_camera,
    small,
    vehicles,
)
from made_scenes import Array, true_lanes

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.rendering.background import coverage
from geoorbit_ros.rendering.conditions import Conditions, illumination
from geoorbit_ros.rendering.renderer import SceneRenderer
from geoorbit_ros.rendering.road_surface import surface_of
from geoorbit_ros.rendering.sensor import Sensor
from geoorbit_ros.rendering.surface import Strip, band, dashes, inside, outside_of
from geoorbit_ros.rendering.trees import add_trees
from geoorbit_ros.scenes.camera import PinholeCamera
from geoorbit_ros.scenes.roads import place_roads
from geoorbit_ros.scenes.scene import load_scene

TRAFFIC = (on_road(226.0, 4.0, TRUCK), on_road(240.0, 8.0), on_road(300.0, 1.8, VAN))


def ground_points(camera: PinholeCamera, pixels: Array) -> Array:
    """(N, 2) points on the road behind pixels (N, 2)."""
    plane = np.linalg.inv(camera.matrix[:, [0, 1, 3]])
    points = np.column_stack([pixels, np.ones(len(pixels))]) @ plane.T
    return np.asarray(points[:, :2] / points[:, 2:])


def distance_to(points: Array, line: Array) -> Array:
    """(N,) distance of points from a polyline."""
    a, step = line[:-1], np.diff(line, axis=0)
    t = ((points[:, None] - a) * step).sum(axis=2) / (step**2).sum(axis=1)
    gap = points[:, None] - (a + np.clip(t, 0, 1)[..., None] * step)
    return np.asarray(np.hypot(gap[..., 0], gap[..., 1]).min(axis=1))


def middle_pixels(mask: Any) -> Array:
    rows, columns = np.nonzero(mask)
    return np.column_stack([columns + 0.5, rows + 0.5])


def test_the_same_input_gives_the_same_bits() -> None:
    placed, camera = road_and_camera()
    again = SceneRenderer(camera, placed, Conditions(clouds=0.0), 1)
    view = vehicles(*TRAFFIC)
    for time_s in (0.0, 3.25):
        assert np.array_equal(again.render(view, time_s), renderer().render(view, time_s))
    other_seed, other_time = renderer(seed=2).render(view, 0.0), again.render(view, 0.04)
    first = again.render(view, 0.0)
    assert not np.array_equal(first, other_seed)
    assert not np.array_equal(first, other_time), "the noise is another in every frame"
    assert difference(first, other_time).mean() < 6.0


def test_an_image_does_not_depend_on_the_frames_before() -> None:
    view = vehicles(*TRAFFIC)
    image = renderer("night", True).render(view, 2.0)
    for k in range(5):
        renderer("night", True).render(vehicles(*TRAFFIC[k % 3 :], first=9), 0.1 * k)
    assert np.array_equal(renderer("night", True).render(view, 2.0), image)


@pytest.mark.parametrize("name", ["straight_3x3", "curve_250m", "night_sparse", "s_curve"])
def test_paint_lies_on_the_boundaries_of_lanes(name: str) -> None:
    placed, camera = road_and_camera(name)
    lanes = true_lanes(small(load_scene(name)))
    mask = coverage(camera, surface_of(placed).paint(0.18))
    ground = ground_points(camera, middle_pixels(mask > 0.5))
    near = np.hypot(*(ground - camera.centre_m[:2]).T) < 70.0
    ground = ground[near]
    lines = [p.offset(k * p.width_m) for p in placed.values() for k in range(p.road.lanes + 1)]
    gap = np.min([distance_to(ground, line) for line in lines], axis=0)
    assert len(ground) > 300
    assert np.quantile(gap, 0.98) < 0.15
    # The outer edges of the road are solid: paint wherever the outermost lanes have a boundary.
    for place in placed.values():
        edge = np.column_stack([place.offset(0.0), np.zeros(len(place.border_m))])
        pixel, depth = camera.project(edge)
        size = np.array(camera.image_size)
        with np.errstate(invalid="ignore"):
            seen = (depth > 5.0) & (depth < 60.0) & np.all((pixel > 2) & (pixel < size - 2), axis=1)
        column, row = pixel[seen].astype(int).T
        assert np.all(mask[row, column] > 0.05)
    assert lanes


def test_pavement_lies_under_every_lane_and_not_beside_the_road() -> None:
    for name in ("off_ramp_diverge", "on_ramp_merge", "urban_turn", "lane_drop"):
        placed, camera = road_and_camera(name)
        surface = surface_of(placed)
        for lane in true_lanes(small(load_scene(name))):
            covered = np.any([inside(lane.centerline_m, strip) for strip in surface.paved], axis=0)
            assert covered.all(), name
            # No line crosses a lane: only its boundaries are painted.
            strips = surface.paint(0.18)
            crossed = np.mean([inside(lane.centerline_m, strip).any() for strip in strips])
            assert crossed == 0.0, name
        off_road = next(iter(placed.values())).offset(-300.0)
        assert not any(inside(off_road, strip).any() for strip in surface.paved)
        assert coverage(camera, surface.paved).max() == 1.0


def test_lanes_alone_are_painted_like_the_road_they_are_of() -> None:
    scene = small(load_scene("straight_3x3"))
    placed, camera = road_and_camera()
    lanes = true_lanes(scene)
    surface = surface_of(lanes)
    mask = coverage(camera, surface.paint(0.18)) > 0.5
    road = coverage(camera, surface_of(placed).paint(0.18)) > 0.1
    assert mask.sum() > 300
    # Edges are where the road has them; dashes may begin elsewhere along the same lines.
    lines = [p.offset(k * p.width_m) for p in placed.values() for k in range(p.road.lanes + 1)]
    ground = ground_points(camera, middle_pixels(mask))
    near = np.hypot(*(ground - camera.centre_m[:2]).T) < 70.0
    gap = np.min([distance_to(ground[near], line) for line in lines], axis=0)
    assert np.quantile(gap, 0.98) < 0.15
    assert (mask & road).sum() > 0.6 * mask.sum()
    assert len(surface.dashed) == 4
    assert len(surface.solid) >= 4
    image = SceneRenderer(camera, lanes).render(nothing(), 0.0)
    assert image.shape == (360, 640, 3)


def test_dashes_are_as_long_as_they_should_be() -> None:
    line = np.column_stack([np.linspace(0, 90, 46), np.zeros(46)])
    pieces = dashes(line, 6.0, 12.0)
    assert [piece[0, 0] for piece in pieces] == pytest.approx([0, 18, 36, 54, 72])
    assert all(np.ptp(piece[:, 0]) == pytest.approx(6.0) for piece in pieces)


def test_a_line_is_cut_where_it_enters_a_strip() -> None:
    line = np.column_stack([np.arange(0.5, 20.0), np.zeros(20)])
    across: Strip = band(np.array([[10.0, -5.0], [10.0, 5.0]]), 6.0)
    pieces = outside_of(line, [across])
    assert [(piece[0, 0], piece[-1, 0]) for piece in pieces] == [(0.5, 6.5), (13.5, 19.5)]


def empty(roads: Any = None, **conditions: Any) -> Array:
    """The empty road, grey, 0 to 255."""
    placed, camera = road_and_camera()
    made = SceneRenderer(camera, roads or placed, Conditions(clouds=0.0, **conditions), 1)
    return np.asarray(made.render(nothing(), 0.0), dtype=np.float64)


@pytest.mark.parametrize("worn", [0.25, 0.5, 0.75])
def test_so_much_of_the_paint_is_gone_and_nothing_else(worn: float) -> None:
    placed, camera = road_and_camera()
    mask = coverage(camera, surface_of(placed).paint(0.18))
    rows = np.arange(mask.shape[0])[:, None] + np.zeros_like(mask)
    near = rows > 0.55 * mask.shape[0]  # where a line is wider than a pixel
    whole, part = (empty(worn=w).mean(axis=2) for w in (0.0, worn))
    bare = empty(worn=0.95).mean(axis=2)
    line, clear = near & (mask > 0.8), near & (mask == 0.0)
    left = ((part - bare)[line] / np.maximum(whole - bare, 20.0)[line]).mean()
    assert left == pytest.approx(1.0 - worn, abs=0.2)
    assert np.abs(part - whole)[clear].mean() < 2.5, "the sensor's noise alone"


def test_shadows_lie_across_the_road_where_the_sun_shines() -> None:
    placed, camera = road_and_camera()
    shade = coverage(camera, surface_of(placed).shaded(70.0, 1.6, 0.3))
    darker = empty().mean(axis=2) - empty(shadows=True).mean(axis=2)
    assert shade.max() > 0.9
    assert darker[shade > 0.9].mean() > 25.0
    assert np.abs(darker[shade == 0.0]).mean() < 2.5
    night = empty(light="night").mean(axis=2) - empty(light="night", shadows=True).mean(axis=2)
    assert np.abs(night[shade > 0.9]).mean() < 6.0


def test_a_yellow_line_is_yellow_and_where_the_white_one_was() -> None:
    placed, camera = road_and_camera()
    scene = small(load_scene("straight_3x3"))
    roads = [road.model_copy(update={"yellow_left_line": True}) for road in scene.roads]
    yellow = place_roads(scene.model_copy(update={"roads": roads}))
    mask = coverage(camera, surface_of(yellow).yellow_paint(0.18)) > 0.8
    assert mask.sum() > 100
    white = coverage(camera, surface_of(placed).paint(0.18))
    assert white[mask].min() > 0.5
    blue, _, red = empty(yellow)[mask].mean(axis=0)
    assert red > 1.8 * blue
    blue, _, red = empty()[mask].mean(axis=0)
    assert red < 1.2 * blue


def test_night_is_darker_than_dusk_and_dusk_than_day() -> None:
    mean = [renderer(light).render(nothing(), 0.0).mean() for light in ("day", "dusk", "night")]
    assert mean[0] > 1.5 * mean[1] > 1.5 * 1.5 * mean[2] > 10.0


def test_rain_takes_contrast_away_and_falls_elsewhere_in_every_frame() -> None:
    dry, wet = (renderer(rain=rain).render(nothing(), 0.0).astype(float) for rain in (False, True))
    assert wet.std() < 0.85 * dry.std()
    later = renderer(rain=True).render(nothing(), 0.04).astype(float)
    calm = renderer().render(nothing(), 0.04).astype(float)
    assert np.abs(later - wet).mean() > np.abs(calm - dry).mean() + 0.3


def test_headlights_light_the_road_ahead() -> None:
    camera = renderer("night")
    _, view_of_camera = road_and_camera()
    away = vehicles(on_road(235.0, 4.0))
    gain = camera.render(away, 0.0).astype(int).sum(axis=2)
    gain = gain - camera.render(nothing(), 0.0).astype(int).sum(axis=2)
    heading, place = float(away.heading[0]), away.xy[0]
    ahead = np.array([np.cos(heading), np.sin(heading)])
    light = []
    for distance_m in (12.0, -12.0):
        pixel, _ = view_of_camera.project(np.append(place + distance_m * ahead, 0.0))
        column, row = pixel.astype(int)
        light.append(gain[row - 2 : row + 3, column - 2 : column + 3].mean())
    assert light[0] > 40.0
    assert abs(light[1]) < 15.0


def test_lamps_shine_white_ahead_and_red_behind() -> None:
    camera = renderer("night")
    for turn_deg, rear in ((0.0, True), (180.0, False)):
        view = vehicles(on_road(235.0, 4.0, CAR, turn_deg))
        image, truth = camera.render_with_boxes(view, 0.0)
        left, top, right, bottom = truth.boxes[0].astype(int)
        part = image[top:bottom, left:right].reshape(-1, 3).astype(int)
        brightest = part[np.argsort(part.sum(axis=1))[-6:]].mean(axis=0)
        blue, _, red = brightest
        if rear:
            assert red > 1.6 * blue
            assert red > 120
        else:
            assert blue > 0.7 * red
            assert red > 180


def test_a_nearer_vehicle_hides_the_lamps_behind_it() -> None:
    camera = renderer("night")
    oncoming, truck = on_road(240.0, 4.0, CAR, 180.0), on_road(230.0, 9.0, TRUCK)
    free = camera.render(vehicles(oncoming), 0.0)
    hidden, truth = camera.render_with_boxes(vehicles(oncoming, truck), 0.0)
    assert truth.visible[0] < 0.8
    left, top, right, bottom = truth.boxes[0].astype(int)
    bright = [int((p[top:bottom, left:right].min(axis=2) > 200).sum()) for p in (free, hidden)]
    assert bright[1] < bright[0]


def test_the_light_drifts_slowly_and_within_its_bounds() -> None:
    sensor = Sensor((64, 36), Conditions(clouds=0.1), 1.0, seed=3)
    seconds = np.arange(0.0, 600.0, 0.2)
    exposure = np.array([sensor.exposure(t) for t in seconds])
    assert np.all(np.abs(exposure - 1.0) <= 0.1 + 1e-9)
    assert np.ptp(exposure) > 0.08
    assert np.abs(np.diff(exposure)).max() / 0.2 < 0.01
    steady = Sensor((64, 36), Conditions(clouds=0.0), 1.0, seed=3)
    assert {steady.exposure(t) for t in seconds[:50]} == {1.0}


def test_the_noise_is_as_strong_as_it_says_and_even() -> None:
    grey = np.full((180, 320, 3), 120, np.uint8)
    sensor = Sensor((320, 180), Conditions(clouds=0.0), 3.0, seed=3)
    noise = sensor.expose(grey, 1.0).astype(float) - 120.0
    assert noise.std() == pytest.approx(3.0, rel=0.15)
    assert abs(noise.mean()) < 0.1
    assert not np.array_equal(noise, sensor.expose(grey, 1.04).astype(float) - 120.0)


def test_trees_stand_beside_the_road_only() -> None:
    for name in ("straight_3x3", "urban_turn", "off_ramp_diverge"):
        placed, camera = road_and_camera(name)
        surface = surface_of(placed)
        light = illumination(Conditions(), 1.0)
        pavement = coverage(camera, surface.paved)
        image = np.zeros((360, 640, 3), np.float32)
        covered = add_trees(image, camera, light, surface, pavement, seed=2)
        assert covered.max() > 0.9
        assert (covered > 0.5).mean() > 0.01
        assert not (covered[pavement > 0.0] > 0.0).any()


def test_images_of_lanes_need_no_sumo() -> None:
    program = (
        "import sys; sys.modules.update(libsumo=None, sumolib=None, traci=None)\n"
        "from geoorbit_ros.rendering.renderer import SceneRenderer\n"
        "from geoorbit_ros.scenes.camera import look_at\n"
        "import numpy as np\n"
        "camera = look_at(np.array([0., 0, 9]), np.array([0., 50, 0]), 60.0, (320, 180))\n"
        "SceneRenderer(camera, [])\n"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    subprocess.run([sys.executable, "-c", program], env=environment, check=True, timeout=240)


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"light": "noon"}, "light: found 'noon', expected one of day, dusk, night"),
        ({"shake_px": -1.0}, "shake_px: found -1, expected 0 to 20 px"),
        ({"clouds": float("nan")}, "clouds: found nan, expected 0 to 0.5"),
        ({"worn": 1.5}, "worn: found 1.5, expected 0 to 0.95"),
    ],
)
def test_impossible_weather_is_refused(values: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ParameterError) as error:
        Conditions(**values)
    assert str(error.value) == sentence
