"""Control points of made-up cameras: a scene knows where its camera stands."""

from __future__ import annotations

from pathlib import Path

from geoorbit_ros.fleet.fleet_file import Fleet
from geoorbit_ros.fleet.plan import calibration_file


def write_scene_calibrations(fleet: Fleet, output: Path) -> None:
    """Write `calibration/<camera>.csv` for every enabled camera with a scene and no file.

    Raises:
        InputFileError: No such scene.
    """
    for camera in fleet.cameras:
        if camera.kind == "scene" and camera.enabled and camera.calibration is None:
            raise NotImplementedError(calibration_file(camera, Path(), output))
