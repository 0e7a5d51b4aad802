"""The fleets of the soak: files of their cameras, and the fleet file's content."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.rendering.conditions import Conditions
from geoorbit_ros.rendering.output import VIDEO, write_rendered_scene
from geoorbit_ros.rendering.rendered_scene import render_scene
from geoorbit_ros.scenes.network import write_network
from geoorbit_ros.scenes.output import CALIBRATION, write_scene_run
from geoorbit_ros.scenes.roads import place_roads
from geoorbit_ros.scenes.scene import Scene, load_scene, shipped_scenes
from geoorbit_ros.scenes.simulate import simulate

CAMERAS, SPACING_M, ROAD_M = 4, 250.0, 1200.0
RECORDED_S = 60.0
TRACK_CAMERAS = 8


@dataclass(frozen=True)
class ImageFormat:
    """Size and rate of the rendered cameras' images."""

    width: int
    height: int
    fps: float


def long_road() -> Scene:
    """The straight motorway, long enough for four cameras."""
    scene = load_scene("straight_3x3")
    piece = scene.roads[0].path[0].model_copy(update={"straight_m": ROAD_M})
    road = scene.roads[0].model_copy(update={"path": [piece]})
    return scene.model_copy(update={"roads": [road, *scene.roads[1:]]})


def beside(scene: Scene, along_m: float) -> Scene:
    """The scene with its camera that far down the road."""
    pole = scene.camera.pole.model_copy(update={"along_m": along_m})
    ahead_m = scene.camera.look_at.along_m - scene.camera.pole.along_m
    look_at = scene.camera.look_at.model_copy(update={"along_m": along_m + ahead_m})
    camera = scene.camera.model_copy(update={"pole": pole, "look_at": look_at})
    return scene.model_copy(update={"camera": camera})


def rendered_fleet(folder: Path, images: ImageFormat) -> dict[str, Any]:
    """Four cameras on one road with films drawn beforehand, a federated server, the road's twin.

    Films that are in the folder already are used again.
    """
    scene, cameras = long_road(), []
    for k in range(CAMERAS):
        name = f"camera_{k}"
        there = folder / f"{name}_{images.width}x{images.height}_{images.fps:g}fps"
        if not there.exists():
            print(f"drawing camera {k + 1} of {CAMERAS}", file=sys.stderr)
            size = (images.width, images.height)
            view = beside(scene, 150.0 + SPACING_M * k)
            shown = render_scene(view, RECORDED_S, 1, Conditions(), fps=images.fps, image_size=size)
            write_rendered_scene(shown, there)
        files = {"source": str(there / VIDEO), "calibration": str(there / CALIBRATION)}
        image_size = [images.width, images.height]
        cameras.append({"id": name, "image_size": image_size, **files})
    net = folder / "net"
    net.mkdir(exist_ok=True)
    datum = Datum(scene.place.latitude_deg, scene.place.longitude_deg)
    network = write_network(place_roads(scene), net, datum)
    return {
        "cameras": cameras,
        "federated_server": {},
        "twin": {"network": str(network)},
        "recorder": {},
    }


def tracks_fleet(folder: Path) -> dict[str, Any]:
    """Eight cameras with recorded boxes, one per shipped scene."""
    cameras = []
    for k, name in enumerate(shipped_scenes()[:TRACK_CAMERAS]):
        there = folder / name
        scene = load_scene(name)
        if not there.exists():
            print(f"recording camera {k + 1} of {TRACK_CAMERAS}: {name}", file=sys.stderr)
            write_scene_run(simulate(scene, RECORDED_S, 1), there, name)
        size = list(scene.camera.image_size)
        camera = {"id": name, "source": f"bag:{there / 'bag'}", "image_size": size}
        cameras.append({**camera, "calibration": str(there / CALIBRATION)})
    return {"cameras": cameras, "recorder": {}}
