"""Bumps, drift, shaking and pans of a camera: what the view watch notices, and what lanes become.

Each film is moved image by image by a motion that is known exactly, with the true boxes of its
vehicles in it. "Noticed" is the time until the state says so. "Error" is the distance, in the mean
over the image, between where the watch puts pixels and where they belong, from three seconds after
the event on, in pixels of an image 1280 px wide. "Lanes" is how far the centrelines lie from those
of the same film that was not moved, at most and with no watch in brackets. "Left out" is the share
of the images that made no tracks.

    python benchmarks/view.py [--scenes NAME,…] [--json FILE]

With FILMS, real films are moved in the same way; without boxes there are no lanes. Times of lost
images (encoding, decoding, moving the image) are no part of the cost.

    python benchmarks/view.py --films FILM …

With FOLDER, real cameras: FOLDER/NAME/ has `image.png`, `calibration.csv` and `tracks.csv`. The
image stands still behind grey vehicles at the places of the tracks, and both are moved.

    python benchmarks/view.py --cameras FOLDER [--names NAME,…]

False alarms: hours of a rendered road in day, dusk, night and rain, which change over into each
other; with FILMS, these in a loop, with light that changes.

    python benchmarks/view.py --hours 24 [--films FILM …]
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.table import Table

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.calibration.plane import Homography
from geoorbit_ros.cli.camera_input import load_camera
from geoorbit_ros.cli.console import console
from geoorbit_ros.cli.inputs import make_mapper
from geoorbit_ros.core.lanes import LaneMap
from geoorbit_ros.lanes.pipeline import map_lanes
from geoorbit_ros.metrics.score import score_lanes
from geoorbit_ros.rendering.conditions import LIGHTS, Conditions
from geoorbit_ros.rendering.rendered_scene import render_scene
from geoorbit_ros.scenes.scene import load_scene
from geoorbit_ros.view.compensation import boxes_in_reference
from geoorbit_ros.view.looks import ViewLook, ViewState
from geoorbit_ros.view.picture import Matrix, shifted, size_of_move
from geoorbit_ros.view.projection import ViewProjector
from geoorbit_ros.view.watch import ViewWatch

Image = NDArray[np.uint8]
FPS, DURATION_S, EVENT_S, SIZE = 25.0, 60.0, 20.0, (1280, 720)
SETTLED_S = 3.0
"""After the event; by then it must have been noticed."""
NOISE = 2.0
"""Grey levels of noise that are added, 1-sigma."""
START_NS = 10**9


@dataclass
class Film:
    """Images as JPEG, and the boxes in them."""

    name: str
    fps: float
    images: list[NDArray[np.uint8]] = field(default_factory=list)
    boxes: list[NDArray[np.void]] = field(default_factory=list)
    plane: Homography | None = None
    size: tuple[int, int] = SIZE

    def image(self, k: int) -> Image:
        """The k-th image, again from the beginning after the last."""
        data = self.images[k % len(self.images)]
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), dtype=np.uint8)


@dataclass
class Still(Film):
    """One image, with a grey vehicle at each box."""

    picture: Image = field(default_factory=lambda: np.zeros((0, 0, 3), np.uint8))

    def image(self, k: int) -> Image:
        """The image at the time of the k-th boxes."""
        shown = self.picture.copy()
        height, width = (int(0.05 * side) for side in shown.shape[:2])
        for row in self.boxes[k % len(self.boxes)]:
            x, y = int(row["x"]), int(row["y"])
            corner = (x + width // 2, y)
            cv2.rectangle(shown, (x - width // 2, y - height), corner, (90, 90, 90), -1)
        return shown


def cameras(folder: Path, names: Sequence[str], fps: float = 25.0) -> Iterator[Still]:
    """Real cameras with an image and tracks, whose first minute is taken."""
    for case in sorted(path.parent for path in folder.glob("*/image.png")):
        if names and case.name not in names:
            continue
        image = np.asarray(cv2.imread(str(case / "image.png")), dtype=np.uint8)
        size = (image.shape[1], image.shape[0])
        text = "{}x{}".format(*size)
        tracks, points = case / "tracks.csv", case / "calibration.csv"
        camera = load_camera(tracks, None, points, case.name, text, None, Path("none.html"))
        film = Still(case.name, fps, plane=camera.homography, size=size, picture=image)
        number = ((camera.frames.stamp_ns - camera.frames.stamp_ns[0]) * fps / 1e9).round()
        first = {int(n): k for k, n in reversed(list(enumerate(number.tolist())))}
        nothing = camera.frames.rows[:0]
        for k in range(round(DURATION_S * fps)):
            film.boxes.append(camera.frames.frame(first[k]) if k in first else nothing)
        yield film


@dataclass(frozen=True)
class Case:
    """What happens to a film.

    Attributes:
        name: For the table.
        motion: Time in seconds to (3, 3), pixels 1280 px wide; None: another place is shown.
        expected: State that must be told.
    """

    name: str
    motion: Callable[[float], Matrix | None]
    expected: ViewState


@dataclass(frozen=True)
class Outcome:
    """What came of it; lengths in metres, pixels at 1280 px width, None where nothing is to say."""

    film: str
    case: str
    noticed_s: float | None
    error_px: float | None
    error_px_p95: float | None
    lanes_m: float | None
    lanes_unwatched_m: float | None
    lanes_changed: int
    left_out: float
    wrong: tuple[str, ...]
    cost: float


def bump(px: float, direction_deg: float, turn_deg: float = 0.0, zoom: float = 0.0) -> Matrix:
    """A shift, and a turn and zoom about the middle of the image."""
    turn, direction = np.radians([turn_deg, direction_deg])
    middle = (np.array(SIZE) - 1.0) / 2
    cos, sin = (1.0 + zoom) * np.cos(turn), (1.0 + zoom) * np.sin(turn)
    linear = np.array([[cos, -sin], [sin, cos]])
    matrix = np.eye(3)
    shift = px * np.array([np.cos(direction), np.sin(direction)])
    matrix[:2, :2], matrix[:2, 2] = linear, middle - linear @ middle + shift
    return matrix


def turned(yaw_deg: float, pitch_deg: float, roll_deg: float, focal_px: float = 1100.0) -> Matrix:
    """What a turn of the camera about its centre does to its image: K R K^-1."""
    yaw, pitch, roll = np.radians([yaw_deg, pitch_deg, roll_deg])
    k = np.array([[focal_px, 0.0, SIZE[0] / 2], [0.0, focal_px, SIZE[1] / 2], [0.0, 0.0, 1.0]])
    rotation = cv2.Rodrigues(np.array([pitch, yaw, roll]))[0]
    matrix = k @ rotation @ np.linalg.inv(k)
    return np.asarray(matrix / matrix[2, 2])


def sway(time_s: float) -> Matrix:
    """Four pixels, 1-sigma, at 2 Hz across and a little down."""
    across = 4.0 * np.sqrt(2.0) * np.sin(2.0 * np.pi * 2.0 * time_s)
    return shifted(float(across), float(1.2 * np.sin(2.0 * np.pi * 1.7 * time_s + 1.0)))


def cases() -> list[Case]:
    """All of them."""
    still = np.eye(3)

    def after(matrix: Matrix) -> Callable[[float], Matrix]:
        return lambda time_s: matrix if time_s >= EVENT_S else still

    def drift(time_s: float) -> Matrix:
        return shifted(*(np.array([8.0, -6.0]) * max(time_s - EVENT_S, 0.0) / 40.0).tolist())

    moved = ViewState.MOVED
    return [
        Case("none", lambda _: still, ViewState.STEADY),
        Case("bump 3 px", after(bump(3, 200)), moved),
        Case("bump 6 px, turn 1°", after(bump(6, 80, 1.0)), moved),
        Case("bump 14 px, zoom 2 %", after(bump(14, 310, 0.0, 0.02)), moved),
        Case("bump 30 px, -1°, -2 %", after(bump(30, 20, -1.0, -0.02)), moved),
        Case("bump 60 px, 1°, 2 %", after(bump(60, 140, 1.0, 0.02)), moved),
        Case("turn 3° right, 0.5° down", after(turned(3.0, 0.5, 0.3)), moved),
        Case("drift 10 px", drift, moved),
        Case("shaking 4 px at 2 Hz", sway, ViewState.SHAKING),
        Case("shaking, bump 14 px", lambda t: sway(t) @ after(bump(14, 60))(t), moved),
        Case(
            "away for 15 s, back",
            lambda t: None if EVENT_S <= t < EVENT_S + 15.0 else still,
            ViewState.OTHER_VIEW,
        ),
        Case(
            "away, back 5 px beside",
            lambda t: None if EVENT_S <= t < EVENT_S + 15.0 else after(bump(5, 100))(t),
            ViewState.OTHER_VIEW,
        ),
    ]


def scaled(motion: Matrix, size: tuple[int, int]) -> Matrix:
    """A motion in pixels 1280 px wide as one in those of an image."""
    share = size[0] / SIZE[0]
    scale = np.diag([share, share, 1.0])
    return np.asarray(scale @ motion @ np.linalg.inv(scale))


def shown(film: Film, other: Film, case: Case, k: int, noise: np.random.Generator) -> Image:
    """What the camera shows at the k-th image."""
    motion = case.motion(k / film.fps)
    image = (film if motion is not None else other).image(k)
    if motion is None:
        return np.asarray(cv2.resize(image, film.size), np.uint8)
    if not np.array_equal(motion, np.eye(3)):
        matrix = scaled(motion, film.size)
        border = cv2.BORDER_REFLECT_101
        image = np.asarray(cv2.warpPerspective(image, matrix, film.size, borderMode=border))
    grains = noise.normal(0.0, NOISE, image.shape[:2]).astype(np.int16)[..., None]
    return np.asarray(np.clip(image.astype(np.int16) + grains, 0, 255), np.uint8)


def watched(film: Film, other: Film, case: Case) -> tuple[list[ViewLook], float]:
    """The looks, and seconds of a core that they took per second of the film."""
    watch, looks, cost_s = ViewWatch(repeats_allowed=True), [], 0.0
    noise = np.random.default_rng(1)
    for k in range(round(DURATION_S * film.fps)):
        stamp_ns = START_NS + round(k / film.fps * 1e9)
        if watch.due(stamp_ns):
            image = shown(film, other, case, k, noise)
            start_s = time.process_time()
            looks.append(watch.look(stamp_ns, image))
            cost_s += time.process_time() - start_s
    return looks, cost_s / DURATION_S


def run(film: Film, other: Film, case: Case, still: LaneMap | None) -> tuple[Outcome, LaneMap]:
    """One film, one case."""
    looks, cost = watched(film, other, case)
    unit = film.size[0] / SIZE[0]
    times = [(look.stamp_ns - START_NS) / 1e9 for look in looks]
    begin_s = 0.0 if case.expected in (ViewState.SHAKING, ViewState.STEADY) else EVENT_S
    quiet_s = DURATION_S if case.expected is ViewState.STEADY else EVENT_S
    timed = list(zip(times, looks, strict=True))
    seen = [t for t, k in timed if t >= begin_s and k.state is case.expected]
    errors = []
    for time_s, look in timed:
        true = case.motion(time_s)
        if time_s >= EVENT_S + SETTLED_S and look.usable and true is not None and look.view == 0:
            off = look.motion @ np.linalg.inv(scaled(true, film.size))
            errors.append(size_of_move(off / off[2, 2], film.size) / unit)
    wrong = sorted({k.state.name for t, k in timed if t < quiet_s})
    usual = {"UNKNOWN", "STEADY", case.expected.name if begin_s == 0.0 else "STEADY"}
    if "shaking" in case.name:
        usual.add("SHAKING")
    lane_map, left_out, unwatched = LaneMap(0, ()), 0.0, None
    distance, changed, lanes_unwatched = None, 0, None
    if film.plane is not None:
        lane_map, left_out = lanes_of(film, case, looks)
        if still is not None and any(case.motion(t) is None for t in np.arange(0.0, DURATION_S)):
            gap = Case(
                case.name,
                lambda t: case.motion(t) if case.motion(t) is None else np.eye(3),
                case.expected,
            )
            still, _ = lanes_of(film, gap, [])
        if still is not None:
            distance, changed = apart(lane_map, still)
            unwatched, _ = lanes_of(film, case, [])
            lanes_unwatched, _ = apart(unwatched, still)
    outcome = Outcome(
        film.name,
        case.name,
        seen[0] - begin_s if seen else None,
        float(np.median(errors)) if errors else None,
        float(np.quantile(errors, 0.95)) if errors else None,
        distance,
        lanes_unwatched,
        changed,
        left_out,
        tuple(name for name in wrong if name not in usual),
        cost,
    )
    return outcome, lane_map


def lanes_of(film: Film, case: Case, looks: Sequence[ViewLook]) -> tuple[LaneMap, float]:
    """Lanes of the film's true boxes, moved as the images were, as the node would make them."""
    assert film.plane is not None
    watched = ViewProjector(BoxProjector(film.plane, film.size))
    waiting = list(looks)

    def frames() -> Iterator[tuple[int, NDArray[np.void]]]:
        for k, rows in enumerate(film.boxes):
            stamp_ns = START_NS + round(k / film.fps * 1e9)
            while waiting and waiting[0].stamp_ns <= stamp_ns:
                yield from watched.look(waiting.pop(0))
            motion = case.motion(k / film.fps)
            if motion is None:
                moved = rows[:0]
            else:
                plain = np.array_equal(motion, np.eye(3))
                there = None if plain else scaled(motion, film.size)
                moved = boxes_in_reference(rows, there, film.size)
            yield from watched.take(stamp_ns, moved)

    lane_map = map_lanes(frames(), make_mapper("curvilinear", 5.0))
    return lane_map, watched.left_out / max(len(film.boxes), 1)


def apart(lane_map: LaneMap, still: LaneMap) -> tuple[float | None, int]:
    """Largest of the lanes' mean distances, metres, and lanes that are missing or new."""
    score = score_lanes(lane_map.confirmed, still.confirmed)
    far = [float(np.mean(row.error_m)) for row in score.matched]
    return (max(far) if far else None), len(score.missed()) + len(score.invented)


def rendered(name: str, fps: float = FPS, duration_s: float = DURATION_S) -> Film:
    """A scene's images, with the boxes of its vehicles."""
    scene = render_scene(load_scene(name), duration_s, 1, fps=fps, image_size=SIZE)
    film = Film(name, fps, plane=fit_homography(scene.control_points))
    for frame in scene:
        film.images.append(cv2.imencode(".jpg", frame.image, (cv2.IMWRITE_JPEG_QUALITY, 92))[1])
        film.boxes.append(frame.boxes[frame.boxes["score"] > 0.3])
    return film


def read(path: Path, most: int = 1500) -> Film:
    """A real film."""
    video = cv2.VideoCapture(str(path))
    film = Film(path.stem, video.get(cv2.CAP_PROP_FPS) or FPS)
    while len(film.images) < most:
        there, image = video.read()
        if not there:
            break
        film.size = (image.shape[1], image.shape[0])
        film.images.append(cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, 92))[1])
    return film


def day(hours: float, fps: float, films: Sequence[Film], name: str) -> dict[str, object]:
    """Hours of changing light, looked at as a live camera is; what was told for no reason.

    Five minutes of each light go round, with new noise in each image; so do the real films, each
    in a light that fades and comes back.
    """
    lights = films or [in_light(name, light, rain=r) for light in LIGHTS for r in (0, 1)]
    order = [0, 1, 0, 2, 4, 5, 3, 1] if not films else list(range(len(films)))
    watch, rng = ViewWatch(repeats_allowed=True), np.random.default_rng(2)
    images = round(hours * 3600 * fps)
    states: dict[str, int] = {}
    far: list[float] = []
    told: list[tuple[float, str]] = []
    part = images / len(order)
    for k in range(images):
        time_s = k / fps
        stamp_ns = START_NS + round(time_s * 1e9)
        if films and k % max(round(part), 1) == 0:  # another camera
            watch = ViewWatch(repeats_allowed=True)
        if not watch.due(stamp_ns):
            continue
        at, share = divmod(k / part, 1.0)
        film = lights[order[int(at) % len(order)]]
        image = film.image(int(time_s * film.fps))
        if films:
            gain = 0.55 + 0.45 * np.cos(2.0 * np.pi * share * 3.0)
            image = np.clip(image * max(gain, 0.12), 0, 255).astype(np.uint8)
        elif share > 0.6:
            following = lights[order[(int(at) + 1) % len(order)]].image(int(time_s * film.fps))
            mix = (share - 0.6) / 0.4
            image = np.asarray(cv2.addWeighted(image, 1.0 - mix, following, mix, 0.0), np.uint8)
        grains = rng.integers(-4, 5, image.shape[:2], dtype=np.int16)[..., None]
        image = np.clip(image.astype(np.int16) + grains, 0, 255).astype(np.uint8)
        look = watch.look(stamp_ns, image)
        states[look.state.name] = states.get(look.state.name, 0) + 1
        if look.usable:
            size = (image.shape[1], image.shape[0])
            far.append(size_of_move(look.motion, size) * SIZE[0] / size[0])
        if look.state not in (ViewState.UNKNOWN, ViewState.STEADY):
            told.append((time_s, look.state.name))
    return {
        "hours": hours,
        "looks": sum(states.values()),
        "states": states,
        "motion_px": {q: float(np.quantile(far, float(q))) for q in ("0.5", "0.99", "1.0")},
        "false_alarms": len(list(itertools.groupby(told, key=lambda k: k[1]))),
        "first": told[:3],
        "references": len(watch.places[0].references),
    }


def in_light(name: str, light: str, *, rain: int) -> Film:
    """Five minutes of a road in one light, two images a second, half as wide."""
    conditions = Conditions(light=next(k for k in LIGHTS if k == light), rain=bool(rain))
    size = (640, 360)
    film = Film(f"{name} {light} {rain}", 2.0, size=size)
    scene = render_scene(load_scene(name), 300.0, 1, conditions, fps=2.0, image_size=size)
    for frame in scene:
        film.images.append(cv2.imencode(".jpg", frame.image, (cv2.IMWRITE_JPEG_QUALITY, 90))[1])
    return film


def tell(outcomes: Sequence[Outcome]) -> None:
    """The table."""
    table = Table(box=SIMPLE_HEAD)
    for title in ("film", "case", "noticed s", "error px (95 %)", "lanes m", "changed", "left out"):
        table.add_column(title)
    table.add_column("wrong before")
    table.add_column("core %")
    for row in outcomes:
        lanes = "–" if row.lanes_m is None else f"{row.lanes_m:.3f}"
        if row.lanes_unwatched_m is not None:
            lanes += f" ({row.lanes_unwatched_m:.2f})"
        error = "–" if row.error_px is None else f"{row.error_px:.2f} ({row.error_px_p95:.2f})"
        table.add_row(
            row.film,
            row.case,
            "–" if row.noticed_s is None else f"{row.noticed_s:.1f}",
            error,
            lanes,
            f"{row.lanes_changed}",
            f"{100.0 * row.left_out:.0f} %",
            ", ".join(row.wrong),
            f"{100.0 * row.cost:.1f}",
        )
    console.print(table)


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--scenes", default="s_curve,motorway_4x4")
    parser.add_argument("--films", type=Path, nargs="*", default=[])
    parser.add_argument("--cameras", type=Path, metavar="FOLDER")
    parser.add_argument("--names", default="")
    parser.add_argument("--hours", type=float)
    parser.add_argument("--road", default="motorway_4x4", help="of the hours")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    films = [read(path) for path in options.films]
    if options.cameras:
        films += cameras(options.cameras, [k for k in options.names.split(",") if k])
    if options.hours:
        console.print_json(data=day(options.hours, FPS, films, options.road))
        return
    outcomes: list[Outcome] = []
    films = films or [rendered(name) for name in options.scenes.split(",")]
    for film, other in zip(films, [*films[1:], films[0]], strict=True):
        still: LaneMap | None = None
        if other is film:
            other = Film("nothing", film.fps, [cv2.imencode(".png", film.image(0)[::-1])[1]])
        for case in cases():
            outcome, lane_map = run(film, other, case, still)
            still = still or (lane_map if film.plane is not None else None)
            outcomes.append(outcome)
            console.print(f"{film.name}: {case.name} done", style="dim")
    tell(outcomes)
    if options.json:
        rows = [asdict(outcome) for outcome in outcomes]
        options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
