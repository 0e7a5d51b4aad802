"""`geoorbit scene`: synthetic roadside cameras with exact ground truth."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from geoorbit_ros.cli.inputs import ForceOption

if TYPE_CHECKING:
    from geoorbit_ros.core.lanes import Lane
    from geoorbit_ros.rendering.rendered_scene import RenderedScene
    from geoorbit_ros.scenes.scene import Scene
    from geoorbit_ros.scenes.simulate import Progress, SceneRun

app = typer.Typer(
    help="Synthetic roadside cameras whose lanes are known exactly (SUMO traffic).",
    no_args_is_help=True,
)

_STEPS = {"traffic": "simulating traffic", "camera": "watching it"}


class LightOption(StrEnum):
    """Time of day."""

    DAY = "day"
    DUSK = "dusk"
    NIGHT = "night"


class DriversOption(StrEnum):
    """Where drivers are in their lanes."""

    MIDDLE = "middle"
    MEASURED = "measured"


DriversArgument = Annotated[
    DriversOption,
    typer.Option(
        help="In the middle of their lanes in the mean, or as measured on motorways: in edge "
        "lanes 0.24 m towards the lane beside, lorries outside."
    ),
]


@app.command("run")
def run(
    scene: Annotated[
        str, typer.Argument(help="A scene file, or a shipped scene (geoorbit scene list).")
    ],
    out: Annotated[Path, typer.Option(help="Folder for the files; new or empty.")],
    duration: Annotated[float, typer.Option(help="Seconds that the camera watches.")] = 60.0,
    seed: Annotated[
        int, typer.Option(help="Another seed gives other vehicles and other errors.")
    ] = 1,
    camera_id: Annotated[
        str | None,
        typer.Option(help="Namespace of the camera in the bag; default: the scene's name."),
    ] = None,
    drivers: DriversArgument = DriversOption.MIDDLE,
    force: ForceOption = False,
) -> None:
    """Let traffic drive past a simulated camera; write what it reports and what is true.

    Into the folder go bag/ and tracks.csv (boxes with the faults of real detectors),
    calibration.csv, truth.geojson (the lanes that the camera could see), and clean_tracks.csv with
    clean_calibration.csv (the same traffic without any fault).

    The same scene, duration and seed give the same files.

    Example: [bold]geoorbit scene run lane_drop --duration 60 --seed 1 --out lane_drop[/bold], then
    [bold]geoorbit lanes --tracks lane_drop/tracks.csv --calibration lane_drop/calibration.csv
    --out lanes.geojson[/bold] and [bold]geoorbit score lanes.geojson lane_drop/truth.geojson[/bold]
    """
    from geoorbit_ros.cli.console import status
    from geoorbit_ros.scenes.output import check_new_folder, write_scene_run
    from geoorbit_ros.scenes.simulate import simulate

    description = _scene(scene, drivers)
    check_new_folder(out, overwrite=force)
    with _shown_progress() as progress:
        result = simulate(description, duration, seed, progress)
    with status("writing"):
        write_scene_run(result, out, camera_id, overwrite=force)
    _print_run(result, out)


def _print_rendered(rendered: RenderedScene, told: str, out: Path) -> None:
    from geoorbit_ros.cli.console import console, say

    _print_lanes(rendered.scene.name, rendered.truth)
    width, height = rendered.image_size
    frames = f"{rendered.frame_count} frames of {width}x{height}"
    say(f"{told}{frames}, {rendered.fps:g} per second.")
    console.print(f" Wrote {out}", soft_wrap=True)


def _scene(name: str, drivers: DriversOption) -> Scene:
    from geoorbit_ros.scenes.scene import load_scene, with_measured_drivers

    scene = load_scene(name)
    return with_measured_drivers(scene) if drivers is DriversOption.MEASURED else scene


@app.command("render")
def render(
    scene: Annotated[
        str, typer.Argument(help="A scene file, or a shipped scene (geoorbit scene list).")
    ],
    out: Annotated[
        Path, typer.Option(help="New folder for video and truth, or a video file (.mp4, .avi).")
    ],
    duration: Annotated[float, typer.Option(help="Seconds that the camera watches.")] = 60.0,
    seed: Annotated[int, typer.Option(help="Another seed gives other vehicles and colours.")] = 1,
    light: Annotated[LightOption, typer.Option(help="Time of day.")] = LightOption.DAY,
    rain: Annotated[bool, typer.Option("--rain", help="Wet road, streaks, no sun.")] = False,
    fps: Annotated[
        float | None, typer.Option(help="Frames per second; default: the scene's.")
    ] = None,
    size: Annotated[
        str | None, typer.Option(help="Width x height, such as 1280x720; default: the scene's.")
    ] = None,
    shake: Annotated[float, typer.Option(help="Sway of the camera in the wind, 1σ in px.")] = 0.0,
    clouds: Annotated[
        float, typer.Option(help="How much the light drifts, as a share of its mean.")
    ] = 0.08,
    worn: Annotated[float, typer.Option(help="Share of the paint that is gone.")] = 0.0,
    shadows: Annotated[
        bool, typer.Option("--shadows", help="Shadows of gantries and guard rails in the sun.")
    ] = False,
    drivers: DriversArgument = DriversOption.MIDDLE,
    force: ForceOption = False,
) -> None:
    """Render a scene: the video that its roadside camera would send.

    Into the folder go video.mp4, tracks.csv and tracks.txt (true boxes with true ids, in
    geoorbit's and in MOTChallenge's format), calibration.csv and truth.geojson: a full test camera.
    Vehicles are where [bold]geoorbit scene run[/bold] has them with the same seed.

    Example: [bold]geoorbit scene render on_ramp_merge --size 1280x720 --fps 25 --out cam[/bold],
    then [bold]geoorbit process cam/video.mp4 --calibration cam/calibration.csv --out result[/bold]
    """
    from geoorbit_ros.rendering.conditions import Conditions
    from geoorbit_ros.rendering.output import write_rendered_scene, write_video
    from geoorbit_ros.rendering.rendered_scene import render_scene
    from geoorbit_ros.scenes.output import check_new_folder
    from geoorbit_ros.storage.frames.video_writer import check_suffix, is_video

    description = _scene(scene, drivers)
    conditions = Conditions(light.value, rain, shake, clouds, worn, shadows)
    image_size = None if size is None else _image_size(size)
    check_suffix(out) if out.suffix else check_new_folder(out, overwrite=force)
    with _shown_progress() as progress:
        rendered = render_scene(description, duration, seed, conditions, fps, image_size, progress)
        if is_video(out):
            write_video(rendered, out)
            told = ""
        else:
            files = write_rendered_scene(rendered, out, overwrite=force)
            told = f"{files.boxes} true boxes of {files.vehicles} vehicles in "
    _print_rendered(rendered, told, out)


@app.command("list")
def list_scenes() -> None:
    """Show the scenes that come with geoorbit.

    Example: [bold]geoorbit scene list[/bold]
    """
    from rich.table import Table

    from geoorbit_ros.cli.console import console
    from geoorbit_ros.scenes.scene import load_scene, shipped_scenes

    table = Table.grid(padding=(0, 2, 0, 0))
    table.add_column(style="bold", no_wrap=True)
    for name in shipped_scenes():
        table.add_row(name, load_scene(name).description)
    console.print(table)


@contextmanager
def _shown_progress() -> Iterator[Progress]:
    """A progress display; steps whose progress is unknown pulse."""
    from geoorbit_ros.cli.console import make_progress

    with make_progress() as display:
        tasks = {step: display.add_task(text, total=None) for step, text in _STEPS.items()}

        def show(step: str, share: float) -> None:
            if share > 0.0:
                display.update(tasks[step], total=1.0, completed=share)

        yield show


def _print_run(result: SceneRun, out: Path) -> None:
    import numpy as np

    from geoorbit_ros.cli.console import console, say

    _print_lanes(result.scene.name, result.truth)
    rows = result.frames.rows
    width, height = result.image_size
    say(
        f"{len(rows)} boxes with {len(np.unique(rows['track_id']))} track ids in "
        f"{len(result.frames)} frames of {width}x{height}; {len(result.control_points)} control "
        f"points."
    )
    console.print(f" Wrote {out}", soft_wrap=True)


def _print_lanes(name: str, lanes: tuple[Lane, ...]) -> None:
    from geoorbit_ros.cli.console import console, make_table
    from geoorbit_ros.report.text import compass

    table = make_table(f"True lanes of {name}", ">lane|direction|>width m|>vehicles|>visible m")
    for lane in lanes:
        table.add_row(
            str(lane.lane_id),
            f"{compass(lane.heading_deg):>2} {lane.heading_deg:3.0f}°",
            f"{lane.width_m:.2f}",
            f"{lane.vehicles:.0f}",
            f"{lane.length_m:.0f}",
        )
    console.print(table)


def _image_size(text: str) -> tuple[int, int]:
    """`1280x720` as numbers.

    Raises:
        ParameterError: It is written otherwise.
    """
    from geoorbit_ros.core.errors import ParameterError

    width, cross, height = text.lower().partition("x")
    if not (cross and width.isdecimal() and height.isdecimal()):
        raise ParameterError("size", f"'{text}'", "width x height, such as 1280x720")
    return int(width), int(height)
