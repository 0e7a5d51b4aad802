"""Draws the figures of docs/twin.md: a map with planted errors, before and after its patch.

    .venv/bin/python docs/make_twin_figures.py

A minute of the scene `straight_3x3` through its camera; its network is given four errors.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.lanes.estimators.estimator import make_estimator
from geoorbit_ros.lanes.mapping.mapper import LaneMapper
from geoorbit_ros.lanes.pipeline import map_lanes, project_frames
from geoorbit_ros.mapcheck.patch import patch_network
from geoorbit_ros.mapcheck.validation_image import save_validation
from geoorbit_ros.roadnet.network import load_network
from geoorbit_ros.scenes.network import write_network
from geoorbit_ros.scenes.roads import place_roads
from geoorbit_ros.scenes.scene import load_scene
from geoorbit_ros.scenes.simulate import simulate

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from scores.map_errors import Error, plant  # benchmarks are not installed

IMAGES = Path(__file__).parent / "images"
SCENE, DURATION_S, SEED = "straight_3x3", 60.0, 1
ERRORS: tuple[tuple[Error, str], ...] = (
    ("missing", "north_0"),
    ("width", "north_0"),
    ("extra", "south_0"),
    ("shifted", "south_1"),
)


def main() -> None:
    """Plant the errors, patch them, draw both."""
    scene = load_scene(SCENE)
    run = simulate(scene, DURATION_S, SEED)
    projector = BoxProjector(fit_homography(run.control_points), run.image_size)
    mapper = LaneMapper(make_estimator("curvilinear"))
    lanes = map_lanes(project_frames(run.frames, projector), mapper).lanes
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        network = load_network(write_network(place_roads(scene), folder, run.datum), run.datum)
        for k, (error, lane) in enumerate(ERRORS):
            work = folder / str(k)
            work.mkdir()
            plant(error, network, lane, folder / f"bad_{k}.net.xml", work)
            network = load_network(folder / f"bad_{k}.net.xml", run.datum)
        out = folder / "out"
        out.mkdir()
        result = patch_network(lanes, network, out)
        for name, road, found in (
            ("before", network, result.before),
            ("after", result.network, result.after),
        ):
            title = f"{SCENE}, a map with errors" + ("" if name == "before" else ", patched")
            path = IMAGES / f"twin-validation-{name}.png"
            save_validation(path, lanes, road, found, title)
            print(f"Wrote {path}")


if __name__ == "__main__":
    main()
