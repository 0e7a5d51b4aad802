"""All that must be there before a fleet's processes start."""

from __future__ import annotations

from collections.abc import Container, Sequence
from pathlib import Path

from geoorbit_ros.federated.keys import Signer, read_private_key, write_private_key
from geoorbit_ros.fleet.fleet_file import Camera, Fleet
from geoorbit_ros.fleet.plan import (
    ROSTER,
    SERVER_KEY,
    FederationKeys,
    ProcessPlan,
    calibration_file,
    image_source,
    make_folders,
    plan_fleet,
    select,
)
from geoorbit_ros.rendering.frame_source import SCENES, SceneFrames
from geoorbit_ros.scenes.output import calibration_text
from geoorbit_ros.storage.atomic import atomic_output
from geoorbit_ros.storage.frames.open_source import open_frame_source
from geoorbit_ros.storage.frames.source import FrameSourceError, LeftOut, SourceOptions


def ask_sources(fleet: Fleet, base: Path, output: Path, chosen: Container[str]) -> Fleet:
    """The fleet with the image sizes of chosen cameras; writes calibrations of made-up ones.

    Args:
        fleet: The fleet.
        base: Folder that relative paths in the fleet file start from.
        output: Made-up cameras' control points go to `calibration/<camera>.csv` in it.
        chosen: Ids of the cameras to ask.

    Raises:
        GeoOrbitError: A video, folder or scene that can't be opened.
    """
    cameras = []
    for camera in fleet.cameras:
        if camera.id in chosen and camera.kind in ("scene", "file"):
            size = (_ask_scene if camera.kind == "scene" else _ask_file)(camera, base, output)
            cameras.append(camera.model_copy(update={"image_size": size}))
        else:
            cameras.append(camera)
    return fleet.model_copy(update={"cameras": cameras})


def _ask_scene(camera: Camera, base: Path, output: Path) -> tuple[int, int]:
    frames = SceneFrames(image_source(camera, base), SourceOptions())
    if camera.calibration is None:
        points = frames.control_points
        file = calibration_file(camera, base, output)
        file.parent.mkdir(parents=True, exist_ok=True)
        with atomic_output(file) as path:
            geodetic = frames.datum.to_geodetic(points.local_m)
            path.write_text(calibration_text(points.pixel, geodetic), encoding="utf-8")
    return frames.image_size


def _ask_file(camera: Camera, base: Path, _output: Path) -> tuple[int, int]:
    """Size of the first image, opened as its node will: what that leaves out is left out here."""
    fps = float(camera.parameters.get("camera", {}).get("fps", 0.0)) or None
    left_out = LeftOut()
    options = SourceOptions(fps=fps, on_bad_frame=left_out, on_cut=left_out)
    source = open_frame_source(image_source(camera, base), options, SCENES)
    with source:
        for _, image in source:
            return int(image.shape[1]), int(image.shape[0])
    found = f"{left_out.count} images that can't be used"
    raise FrameSourceError(source.name, found, "at least one that can")


def prepare(
    fleet: Fleet, base: Path, output: Path, only: Sequence[str] = ()
) -> tuple[ProcessPlan, ...]:
    """Look at the sources, make folders and keys, and return the plan to run.

    Args:
        fleet: The fleet.
        base: Folder that relative paths in the fleet file start from.
        output: Folder of logs, recordings and state.
        only: Names of the processes to run; none: all.

    Raises:
        GeoOrbitError: A file, source or key that can't be used.
    """
    chosen = {plan.name for plan in select(plan_fleet(fleet, base, output), only)}
    fleet = ask_sources(fleet, base, output, chosen)
    make_folders(fleet, output)
    keys = None
    if fleet.federated_server and fleet.federated_server.enabled:
        names = [camera.id for camera in fleet.cameras if camera.enabled]
        keys = federation_keys(output / "keys", names)
    return select(plan_fleet(fleet, base, output, keys), only)


def federation_keys(folder: Path, camera_ids: Sequence[str]) -> FederationKeys:
    """Read the keys of server and cameras, make those that are missing, and write the roster.

    Raises:
        FederationError: A key file that is broken or can't be written.
    """
    server = _public(folder / SERVER_KEY)
    cameras = {name: _public(folder / f"{name}.key") for name in camera_ids}
    with atomic_output(folder / ROSTER) as path:
        lines = (f"{name} {key}\n" for name, key in cameras.items())
        path.write_text("".join(lines), encoding="utf-8")
    return FederationKeys(folder, server, cameras)


def _public(file: Path) -> str:
    if not file.exists():
        return write_private_key(file).hex()
    public = Signer(read_private_key(file), "").public
    assert public is not None  # it was made from a key
    return public.hex()
