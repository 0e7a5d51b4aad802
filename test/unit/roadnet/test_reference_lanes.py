"""The network's lanes in a camera's view: one per physical lane, cut to what is seen."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from made_twin import DATUM, made_network, made_roads

from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.core.errors import RoadNetworkError
from geoorbit_ros.core.polylines import project
from geoorbit_ros.roadnet.network import RoadNetwork, load_network
from geoorbit_ros.roadnet.reference_lanes import inside, lane_chains, reference_lanes, view_polygon
from geoorbit_ros.scenes.network import write_network
from geoorbit_ros.scenes.roads import place_roads
from geoorbit_ros.scenes.scene import load_scene
from geoorbit_ros.scenes.simulate import scene_camera, survey_control_points
from geoorbit_ros.scenes.truth import visible_lanes

EVERYWHERE = np.array([(-900.0, -900.0), (900.0, -900.0), (900.0, 900.0), (-900.0, 900.0)])


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> RoadNetwork:
    return load_network(made_network(tmp_path_factory.mktemp("net")))


def test_a_lane_goes_on_over_its_edge(network: RoadNetwork) -> None:
    lanes = reference_lanes(network, EVERYWHERE)
    assert [lane.lane_id for lane in lanes] == list(range(1, 7))
    lengths = sorted(round(lane.length_m, -1) for lane in lanes)
    assert lengths == [110, 300, 300, 500, 500, 500]  # the ramp, two west, three round the bend
    roads = made_roads()
    for lane in lanes:
        assert lane.width_m == pytest.approx(3.5)
        for line, offset in ((lane.left_m, 1.75), (lane.right_m, -1.75)):
            found = project(line[5:-5], lane.centerline_m)
            assert np.abs(found.offset_m - offset).max() < 0.02
    bent = project(roads["bend"].centerline(0)[3:-3], lanes[0].centerline_m).offset_m
    assert np.abs(bent).max() < 0.02


def test_each_lane_is_in_one_chain(network: RoadNetwork) -> None:
    chains = [lane for chain in lane_chains(network) for lane in chain]
    assert len(chains) == len(set(chains))
    outside = {lane for lane in range(len(network)) if not network.internal[lane]}
    assert outside <= set(chains)


def test_lanes_are_cut_to_the_view(network: RoadNetwork) -> None:
    view = np.array([(100.0, -60.0), (180.0, -60.0), (180.0, 60.0), (100.0, 60.0)])
    lanes = reference_lanes(network, view)
    assert len(lanes) == 5
    for lane in lanes:
        assert lane.length_m == pytest.approx(80.0, abs=1.5)
        assert inside(lane.centerline_m, view).all()


def test_a_camera_beside_the_network_is_one_sentence(network: RoadNetwork) -> None:
    with pytest.raises(RoadNetworkError, match="no lane in the camera's view, the nearest is"):
        reference_lanes(network, EVERYWHERE / 30.0 + np.array([5000.0, 0.0]))


@pytest.mark.parametrize("name", ["on_ramp_merge", "curve_250m", "lane_drop"])
def test_references_are_the_lanes_that_a_scene_s_camera_sees(name: str, tmp_path: Path) -> None:
    """As many as the scene counts, and where they are, to a decimetre."""
    scene = load_scene(name)
    placed = place_roads(scene)
    network = load_network(write_network(placed, tmp_path, DATUM))
    camera = scene_camera(scene, placed)
    points = survey_control_points(placed, camera, DATUM, 1)
    exact, _ = camera.project(np.column_stack((points.local_m, np.zeros(len(points)))))
    homography = fit_homography(dataclasses.replace(points, pixel=exact))
    lanes = reference_lanes(network, view_polygon(homography, camera.image_size))
    truth = visible_lanes(placed, camera)
    assert len(lanes) >= len(truth)
    for seen in truth:
        found = [project(seen.lane.centerline_m, lane.centerline_m) for lane in lanes]
        best = max(
            np.count_nonzero(p.inside & (np.abs(p.offset_m) < 0.1)) / len(p.inside) for p in found
        )
        assert best > 0.8  # by another rule, seen may begin and end elsewhere
