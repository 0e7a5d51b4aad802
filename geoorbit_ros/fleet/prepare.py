"""All that must be there before a fleet's processes start."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from pathlib import Path

from geoorbit_ros.calibration.control_point_writer import write_control_points
from geoorbit_ros.core.errors import GeoOrbitError, InputFileError
from geoorbit_ros.core.input_report import InputReport, Treatment
from geoorbit_ros.federated.keys import Signer, read_private_key, write_private_key
from geoorbit_ros.fleet.fleet_file import Camera, Fleet
from geoorbit_ros.fleet.plan import (
    ROSTER,
    SERVER_KEY,
    FederationKeys,
    ProcessPlan,
    calibration_file,
    image_size,
    image_source,
    make_folders,
    missing_files,
    plan_fleet,
    select,
    without,
)
from geoorbit_ros.rendering.frame_source import SCENES, SceneFrames, read_scene_spec
from geoorbit_ros.storage.atomic import atomic_output
from geoorbit_ros.storage.bag_reader import describe_bag
from geoorbit_ros.storage.frames.open_source import open_frame_source
from geoorbit_ros.storage.frames.source import FrameSourceError, LeftOut, SourceOptions
from geoorbit_ros.storage.playback import played_topics


def leave_out(fleet: Fleet, faults: Mapping[str, str], report: InputReport) -> Fleet:
    """The fleet without the cameras and services that have a fault.

    Args:
        fleet: The fleet.
        faults: What is wrong with them, by name.
        report: Takes it; refuses the fleet when most of its cameras are left out.

    Raises:
        InputFileError: It is refused.
    """
    cameras = {camera.id for camera in fleet.cameras}
    for name, fault in faults.items():
        if name in cameras:
            report.add(Treatment.LEFT_OUT, 1, f"{name}: {fault}")
        else:
            report.note(Treatment.LEFT_OUT, f"{name} is left out: {fault}")
    report.check(strict=False, expected="a fleet of which most cameras can be used")
    return without(fleet, faults) if faults else fleet


def leave_out_missing(fleet: Fleet, base: Path, report: InputReport) -> Fleet:
    """The fleet without what names files or passwords that are not there.

    Args:
        fleet: The fleet.
        base: Folder that relative paths in the fleet file start from.
        report: Takes what is left out.

    Raises:
        InputFileError: Most cameras are.
    """
    missing = missing_files(fleet, base)
    faults = {name: f"no {', no '.join(map(str, files))}" for name, files in missing.items()}
    for camera in fleet.cameras:
        try:
            if camera.enabled and camera.id not in faults:
                camera.address(base)
                if camera.kind == "scene":
                    read_scene_spec(camera.source)
        except GeoOrbitError as error:  # no password where it should be, or no such scene
            faults[camera.id] = str(error)
    return leave_out(fleet, faults, report)


def ask_sources(
    fleet: Fleet,
    base: Path,
    output: Path,
    chosen: Container[str],
    report: InputReport | None = None,
) -> Fleet:
    """The fleet with the image sizes of chosen cameras; writes calibrations of made-up ones.

    Args:
        fleet: The fleet.
        base: Folder that relative paths in the fleet file start from.
        output: Made-up cameras' control points go to `calibration/<camera>.csv` in it.
        chosen: Ids of the cameras to ask.
        report: Takes cameras that can't be used, which are left out; None: the first is refused.

    Raises:
        GeoOrbitError: A video, folder, bag or scene that can't be opened.
    """
    cameras, faults = [], {}
    for camera in fleet.cameras:
        ask = _ASK.get(camera.kind) if camera.id in chosen else None
        try:
            update = {"image_size": ask(camera, base, output)} if ask else {}
            cameras.append(camera.model_copy(update=update))
        except GeoOrbitError as error:
            if report is None:
                raise
            faults[camera.id] = str(error)
            cameras.append(camera)
    fleet = fleet.model_copy(update={"cameras": cameras})
    return fleet if report is None else leave_out(fleet, faults, report)


def _ask_bag(camera: Camera, base: Path, _output: Path) -> tuple[int, int]:
    """A bag does not tell the size of its images; but whether it has boxes of one camera."""
    path = base / camera.source.partition(":")[2]
    only = str(camera.parameters.get("bag_player", {}).get("topics", "")).split()
    topics = [t.name for t in describe_bag(path).topics if not only or t.name in only]
    played = played_topics(topics, camera.id, str(path))
    if f"/{camera.id}/tracks_px" not in played.values():
        found = f"only {', '.join(topics)}" if topics else "no topic"
        raise InputFileError(str(path), found, "a topic of tracked boxes, /CAMERA/tracks_px")
    return image_size(camera)


def _ask_scene(camera: Camera, base: Path, output: Path) -> tuple[int, int]:
    frames = SceneFrames(image_source(camera, base), SourceOptions())
    if camera.calibration is None:
        file = calibration_file(camera, base, output)
        file.parent.mkdir(parents=True, exist_ok=True)
        write_control_points(file, frames.control_points)
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


_ASK = {"scene": _ask_scene, "file": _ask_file, "bag": _ask_bag}
"""How to look at a source, by its kind; streams are opened by their nodes."""


def prepare(
    fleet: Fleet,
    base: Path,
    output: Path,
    only: Sequence[str] = (),
    report: InputReport | None = None,
) -> tuple[ProcessPlan, ...]:
    """Look at the sources, make folders and keys, and return the plan to run.

    Args:
        fleet: The fleet.
        base: Folder that relative paths in the fleet file start from.
        output: Folder of logs, recordings and state.
        only: Names of the processes to run; none: all.
        report: Takes cameras that can't be used, which are left out; None: the first is refused.

    Raises:
        GeoOrbitError: A file, source or key that can't be used.
    """
    chosen = {plan.name for plan in select(plan_fleet(fleet, base, output), only)}
    fleet = ask_sources(fleet, base, output, chosen, report)
    make_folders(fleet, output)
    keys = None
    if fleet.federated_server and fleet.federated_server.enabled:
        names = [camera.id for camera in fleet.cameras if camera.enabled]
        keys = federation_keys(output / "keys", names)
    plans = plan_fleet(fleet, base, output, keys)
    left = {plan.name for plan in plans}
    return select(plans, [name for name in only if name in left] if report else only)


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
