"""`geoorbit camera`: from a video or stream to a working fleet entry."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from geoorbit_ros.cli.inputs import (
    CalibrationOption,
    CameraInfoOption,
    DatumOption,
    ModelOption,
    PasswordFileOption,
    SourceArgument,
    StrictPointsOption,
    load_calibration,
)

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from geoorbit_ros.calibration.plane import Homography
    from geoorbit_ros.cli.camera_run import CameraJob

app = typer.Typer(help="Set up cameras of a fleet.", no_args_is_help=True)

CALIBRATION_IMAGE = "calibration.png"


@app.command("add")
def add(
    source: SourceArgument,
    calibration: CalibrationOption,
    camera_id: Annotated[str, typer.Option("--camera-id", help="Its name: letters, digits, _.")],
    fleet: Annotated[
        Path, typer.Option("--fleet", help="The fleet file to add it to; made if not there.")
    ],
    out: Annotated[Path, typer.Option("--out", help="New folder for image, lanes and report.")],
    model: ModelOption = None,
    duration: Annotated[
        float, typer.Option("--duration", min=1.0, metavar="SECONDS", help="How long to watch.")
    ] = 60.0,
    datum: DatumOption = None,
    camera_info: CameraInfoOption = None,
    password_file: PasswordFileOption = None,
    replace: Annotated[
        bool, typer.Option("--replace", help="Put it in the place of the camera with this id.")
    ] = False,
    strict: StrictPointsOption = False,
) -> None:
    """Check a camera's calibration, watch it for a minute, and add it to a fleet file.

    Draws the control points with their errors into an image, says how far the camera can see,
    finds lanes, and says how many more vehicles each needs. The fleet file is changed last.

    Example: [bold]geoorbit camera add north.mp4 --calibration north.csv --camera-id north
    --fleet fleet.yaml --out north_check[/bold]
    """
    from geoorbit_ros.cli.camera_run import REPORT, CameraJob
    from geoorbit_ros.cli.console import as_typed, console, print_lanes, print_remarks, say
    from geoorbit_ros.cli.images import ImageOptions, first_image
    from geoorbit_ros.cli.resume import prepared_run
    from geoorbit_ros.detection.detector import DetectorSettings
    from geoorbit_ros.fleet.fleet_io import add_camera, check_new_camera
    from geoorbit_ros.scenes.output import check_new_folder
    from geoorbit_ros.storage.atomic import atomic_output
    from geoorbit_ros.storage.frames.source import LeftOut

    check_new_folder(out, overwrite=replace)
    check_new_camera(fleet, camera_id, replace=replace)
    named = (calibration, datum or _known_datum(fleet, camera_id))
    plane = load_calibration(*named, strict=strict, camera_info=camera_info)
    watched = ImageOptions(None, duration, "", LeftOut(), password_file)
    prepared = prepared_run(source, out, watched, model, DetectorSettings(), resume=None)
    with prepared as (images, run), atomic_output(out, overwrite=replace) as folder:
        job = CameraJob(camera_id, calibration, *plane, run)
        folder.mkdir()
        _show_calibration(plane[0], first_image(images), folder / CALIBRATION_IMAGE)
        job.find_lanes(images, duration)
        job.write(folder, images)
        entry = _entry(job, source, password_file, model, fleet, camera_info)
        add_camera(fleet, entry, replace=replace)
    print_remarks(images.remarks)
    print_lanes(job.lane_map, f"Lanes of {camera_id}")
    print_remarks(*job.reports)
    say(f"Look at {out / CALIBRATION_IMAGE} and {out / REPORT}.")
    run_it = as_typed(f"up {fleet}")
    console.print(f" Camera {camera_id} is in {fleet}. To run it: {run_it}", soft_wrap=True)


@app.command("remove")
def remove(
    camera_id: Annotated[str, typer.Argument(help="Its id in the fleet file.")],
    fleet: Annotated[Path, typer.Option("--fleet", help="The fleet file.")],
) -> None:
    """Take a camera out of a fleet file. What it recorded stays.

    Example: [bold]geoorbit camera remove north --fleet fleet.yaml[/bold]
    """
    from geoorbit_ros.cli.console import say
    from geoorbit_ros.fleet.fleet_io import remove_camera

    left = remove_camera(fleet, camera_id)
    say(f"Removed {camera_id} from {fleet}; it has {', '.join(c.id for c in left.cameras)}.")


def _known_datum(fleet: Path, camera_id: str) -> str | None:
    """A camera that is checked again keeps its origin: its map and recordings stay in place."""
    from geoorbit_ros.fleet.fleet_io import datum_of

    place = datum_of(fleet, camera_id)
    return None if place is None else f"{place.latitude_deg!r},{place.longitude_deg!r}"


def _entry(
    job: CameraJob,
    source: str,
    password_file: Path | None,
    model: Path | None,
    fleet: Path,
    camera_info: Path | None,
) -> dict[str, object]:
    """The camera as the fleet file names it."""
    from geoorbit_ros.core.addresses import masked
    from geoorbit_ros.fleet.fleet_io import relative

    entry: dict[str, object] = {
        "id": job.camera_id,
        "source": relative(Path(source), fleet) if Path(source).exists() else masked(source),
        "calibration": relative(job.calibration, fleet),
        "image_size": list(job.run.image_size),
        "datum": {
            "latitude_deg": job.datum.latitude_deg,
            "longitude_deg": job.datum.longitude_deg,
        },
    }
    for key, file in (("model", model), ("camera_info", camera_info)):
        if file is not None:
            entry[key] = relative(file, fleet)
    return entry | _password(source, password_file, job, fleet)


def _password(
    source: str, password_file: Path | None, job: CameraJob, fleet: Path
) -> dict[str, object]:
    """Where the fleet finds the camera's password: a file that only its owner can read."""
    from geoorbit_ros.core.addresses import is_address, secrets_of
    from geoorbit_ros.fleet.fleet_io import relative

    if password_file is None and is_address(source) and (secrets := secrets_of(source)):
        password_file = fleet.absolute().parent / f"{job.camera_id}.password"
        password_file.touch(mode=0o600)
        password_file.chmod(0o600)
        password_file.write_text("\n".join(secrets) + "\n", encoding="utf-8")
    return {} if password_file is None else {"password_file": relative(password_file, fleet)}


def _show_calibration(homography: Homography, image: NDArray[np.uint8], out: Path) -> None:
    """Draw the control points into an image file, and print their errors."""
    from geoorbit_ros.calibration.homography import plane_of_images
    from geoorbit_ros.cli.console import console, make_table, say
    from geoorbit_ros.report.calibration_image import REACH_M, draw_calibration, reach
    from geoorbit_ros.report.image_overlay import write_image

    homography = plane_of_images(homography, (image.shape[1], image.shape[0]))
    write_image(out, draw_calibration(image, homography))
    table = make_table("Control points", ">point|>pixel x|>pixel y|>error px|>error m|used")
    residual = homography.residual
    for k, (x, y) in enumerate(homography.points.pixel):
        used = "[green]yes[/]" if residual.inlier[k] else "[red]no[/]"
        errors = (f"{residual.pixel_error[k]:.2f}", f"{residual.ground_error_m[k]:.3f}")
        table.add_row(str(k + 1), f"{x:.0f}", f"{y:.0f}", *errors, used)
    console.print(table)
    far = reach(homography, (image.shape[1], image.shape[0]))
    say(
        f"The camera sees {far.farthest_m:.0f} m of road, measured up the middle of its image to "
        f"where an error of one pixel is {REACH_M:g} m on the road."
    )
