"""Populations to learn from: many cameras drawn at random, and recordings of real ones."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.tables import TRACK_DTYPE, Frames
from geoorbit_ros.lanes.pipeline import StampedRows, project_frames
from geoorbit_ros.learning.camera_task import CameraTask
from geoorbit_ros.learning.features import scene_features
from geoorbit_ros.scenes.random_scene import random_scene
from geoorbit_ros.scenes.roads import place_roads
from geoorbit_ros.scenes.scene import Scene
from geoorbit_ros.scenes.simulate import scene_camera, simulate
from geoorbit_ros.scenes.truth import visible_lanes
from geoorbit_ros.storage.yaml_file import StrictModel, read_yaml

Split = Literal["seen", "unseen"]

DAY_S = 86400
"""Seconds of a day."""
MAX_RATE_HZ = 5.0
"""Frames per second that are kept: a vehicle's errors hardly change in a fifth of a second, and the
search runs an estimator some ten thousand times."""
MIN_GAP_NS = round(0.9e9 / MAX_RATE_HZ)
"""Jitter must not drop every other frame of a camera that has this very rate."""


class Cameras(StrictModel):
    """A run of random scenes: seeds `first` to `first + count - 1`."""

    first: Annotated[int, Field(ge=0)]
    count: Annotated[int, Field(ge=0, le=10000)]


class MapErrors(StrictModel):
    """How the reference that cameras learn from differs from the truth, as OpenStreetMap does.

    Attributes:
        offset_sigma_m: Each camera's map is displaced as a whole by a normal error, east and north.
        width_step_m: Widths are rounded to this; 0 keeps them.
    """

    offset_sigma_m: Annotated[float, Field(ge=0.0, le=10.0)] = 0.5
    width_step_m: Annotated[float, Field(ge=0.0, le=2.0)] = 0.25


class Recording(StrictModel):
    """A real camera, by its files; paths are relative to `Population.recordings_root`."""

    camera_id: str
    split: Split = "unseen"
    tracks: str
    calibration: str
    network: str
    image_size: tuple[int, int] = (1920, 1080)
    longitude_deg: float = 0.0


class Population(StrictModel):
    """A population file.

    Attributes:
        name: What tables call it.
        duration_s: How long each camera watches.
        seed: Of traffic, detector faults and map errors.
        seen: Cameras that take part in training.
        unseen: Cameras that take no part, and by which models are compared.
        draws: How many fleets are drawn, each with cameras of its own, the next ones in the order
            of their seeds. Training with seed k uses draw k modulo `draws`. Recordings belong to
            every draw.
        tilt_deg: In the middle of the view the first lane runs east or west, up to this many
            degrees off. Without it roads run anywhere.
        map: Errors of the reference that is learned from.
        recordings_root: Environment variable that names the folder of the recordings. Where it is
            not set, they are left out.
        recordings: Real cameras.
    """

    name: str
    duration_s: Annotated[float, Field(ge=10.0, le=3600.0)] = 60.0
    seed: Annotated[int, Field(ge=0)] = 1
    seen: Cameras
    unseen: Cameras
    draws: Annotated[int, Field(ge=1, le=1000)] = 1
    tilt_deg: Annotated[float, Field(ge=0.0, le=90.0)] | None = None
    map: MapErrors = MapErrors()
    recordings_root: str = "GEOORBIT_REAL_DATA"
    recordings: tuple[Recording, ...] = ()

    @property
    def scenes(self) -> dict[str, tuple[int, Split]]:
        """Scene seed and split by camera id."""
        found: dict[str, tuple[int, Split]] = {}
        splits: tuple[tuple[Split, Cameras], ...] = (("seen", self.seen), ("unseen", self.unseen))
        for split, cameras in splits:
            for seed in range(cameras.first, cameras.first + cameras.count):
                found[f"camera_{seed:05d}"] = seed, split
        return found

    def of_draw(self, draw: int) -> Population:
        """The population that is one of the draws; the number counts on over the last."""
        later = draw % self.draws
        seen, unseen = (
            Cameras(first=cameras.first + later * cameras.count, count=cameras.count)
            for cameras in (self.seen, self.unseen)
        )
        return self.model_copy(update={"seen": seen, "unseen": unseen, "draws": 1})

    def recordings_folder(self) -> Path | None:
        """Where the recordings lie; None where the environment does not say."""
        root = os.environ.get(self.recordings_root)
        return Path(root) if root else None


def load_population(path: Path) -> Population:
    """Read a population file.

    Raises:
        InputFileError: No such file, or the first value that is wrong.
    """
    return read_yaml(path, Population, "population")


def scene_task(population: Population, camera_id: str, scene_seed: int) -> CameraTask:
    """Let traffic pass a random camera and note what it has seen; takes seconds.

    The same population and seed give the same task.
    """
    random = np.random.default_rng([population.seed, scene_seed, 14])
    scene = random_scene(scene_seed)
    if population.tilt_deg is not None:
        along = float(random.uniform(-population.tilt_deg, population.tilt_deg))
        scene = _turned(scene, 90.0 + along + float(random.choice([0.0, 180.0])))
    start_s = int(random.integers(DAY_S))
    run = simulate(scene, population.duration_s, population.seed)
    projector = BoxProjector(fit_homography(run.control_points), run.image_size)
    tracks = thin(project_frames(run.frames, projector), start_s * 1_000_000_000)
    return CameraTask(
        camera_id,
        tracks,
        scene_features(tracks),
        _as_mapped(run.truth, population.map, random),
        run.truth,
    )


def thin(frames: Iterable[StampedRows], later_ns: int = 0) -> Frames:
    """At most `MAX_RATE_HZ` frames per second; every stamp is moved by `later_ns`."""
    stamps: list[int] = []
    tables: list[NDArray[np.void]] = []
    for stamp_ns, rows in frames:
        if stamps and stamp_ns + later_ns - stamps[-1] < MIN_GAP_NS:
            continue
        stamps.append(stamp_ns + later_ns)
        tables.append(rows)
    offset = np.append(0, np.cumsum([len(rows) for rows in tables])).astype(np.int64)
    rows = np.frombuffer(b"".join(rows.tobytes() for rows in tables), TRACK_DTYPE)
    return Frames(np.array(stamps, dtype=np.int64), offset, rows)


def _as_mapped(
    truth: tuple[Lane, ...], errors: MapErrors, random: np.random.Generator
) -> tuple[Lane, ...]:
    """The lanes as a public map would have them."""
    offset = errors.offset_sigma_m * random.standard_normal(2)
    lanes = []
    for lane in truth:
        step = errors.width_step_m
        width = lane.width_m if step == 0.0 else round(lane.width_m / step) * step
        lanes.append(
            replace(
                lane,
                centerline_m=lane.centerline_m + offset,
                left_m=lane.left_m + offset,
                right_m=lane.right_m + offset,
                width_m=width,
            )
        )
    return tuple(lanes)


def _turned(scene: Scene, heading_deg: float) -> Scene:
    """The scene turned about its origin until its first visible lane has this heading half-way.

    Poles, targets and all other roads hang on the roads that have a start of their own.
    """
    placed = place_roads(scene)
    lane = visible_lanes(placed, scene_camera(scene, placed))[0].lane
    turn_deg = heading_deg - lane.heading_deg
    turn = np.exp(-1j * np.radians(turn_deg))
    content: dict[str, Any] = scene.model_dump(exclude_unset=True)
    for road in content["roads"]:
        start = road.get("start")
        if start:
            at = complex(start["x_m"], start["y_m"]) * turn
            heading = (start["heading_deg"] + turn_deg) % 360.0
            road["start"] = {"x_m": at.real, "y_m": at.imag, "heading_deg": heading}
    return Scene.model_validate(content)
