"""Laws of random scenes: repeatable, varied within their bounds, usable like any other scene."""

from __future__ import annotations

import numpy as np
import pytest
from made_scenes import camera_of, true_lanes

from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.scenes.random_scene import SEEN_M, SEEN_SHARE, random_scene
from geoorbit_ros.scenes.roads import lane_chains, place_roads
from geoorbit_ros.scenes.scene import Scene
from geoorbit_ros.scenes.simulate import simulate

SEEDS = range(60)


@pytest.fixture(scope="module")
def scenes() -> list[Scene]:
    return [random_scene(seed) for seed in SEEDS]


def test_the_seed_decides_everything(scenes: list[Scene]) -> None:
    assert [random_scene(seed) for seed in SEEDS[:5]] == scenes[:5]
    assert len({scene.model_dump_json() for scene in scenes}) == len(scenes)


def test_a_random_scene_survives_being_written_and_read(scenes: list[Scene]) -> None:
    for scene in scenes:
        assert Scene.model_validate(scene.model_dump(exclude_none=True, mode="json")) == scene


def test_three_quarters_of_the_lanes_are_in_view(scenes: list[Scene]) -> None:
    for scene in scenes[:20]:
        seen = [lane for lane in true_lanes(scene) if lane.length_m >= SEEN_M]
        assert len(seen) >= SEEN_SHARE * len(lane_chains(place_roads(scene)))


def test_roads_and_cameras_are_as_varied_as_the_description_says(scenes: list[Scene]) -> None:
    main = [scene.roads[0] for scene in scenes]
    assert {road.lanes for road in main} == {1, 2, 3, 4, 5}
    headings = [road.start.heading_deg for road in main if road.start]
    assert len(np.unique(np.floor(np.array(headings) / 45.0))) == 8
    ids = [{road.id for road in scene.roads} for scene in scenes]
    assert 0.4 < np.mean(["back" in names for names in ids]) < 0.9
    assert any("main_ramp" in names for names in ids)
    assert any("main_b" in names and "main_c" not in names for names in ids)
    turns = {np.sign(p.turn_deg) for scene in scenes for road in scene.roads for p in road.path}
    assert turns == {-1.0, 0.0, 1.0}
    widths = [scene.lane_width_m for scene in scenes]
    assert 3.0 <= min(widths) < 3.2
    assert 3.6 < max(widths) <= 3.8
    heights = [camera_of(scene).centre_m[2] for scene in scenes]
    assert 7.0 <= min(heights) < 9.0
    assert 18.0 < max(heights) <= 20.0
    assert {scene.camera.image_size[0] for scene in scenes} == {1280, 1920, 3840}
    assert {np.sign(scene.camera.pole.right_m) for scene in scenes} == {-1.0, 1.0}


def test_the_opposite_carriageway_keeps_its_distance(scenes: list[Scene]) -> None:
    """Left borders run beside each other, `median` apart along their whole length."""
    for scene in (s for s in scenes if any(road.id == "back" for road in s.roads)):
        placed = place_roads(scene)
        mainline = [name for name in placed if name in ("main", "main_a", "main_b", "main_c")]
        corners = np.concatenate([placed[name].border_m for name in mainline])
        share = np.linspace(0.0, len(corners) - 1.0, 20 * len(corners))
        main = np.column_stack(
            [np.interp(share, np.arange(len(corners)), corners[:, k]) for k in range(2)]
        )
        back = placed["back"].border_m
        gap = [float(np.min(np.hypot(*(main - point).T))) for point in back[5:-5]]
        assert max(gap) - min(gap) < 0.05
        assert max(gap) <= 12.05


@pytest.mark.parametrize("seed", [7, 4, 30, 24])
def test_ramps_drops_and_beginning_lanes_simulate(seed: int) -> None:
    run = simulate(random_scene(seed), 10.0, 1)
    assert len(run.frames.rows) > 100
    assert fit_homography(run.control_points) is not None
    assert sum(lane.vehicles for lane in run.truth) > 0
