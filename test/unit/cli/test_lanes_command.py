"""`geoorbit lanes`, `score` and `report` end to end, and what wrong input gets."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from camera_files import CameraFiles, write_tracks
from made_markings import image_with_lines

from geoorbit_ros.cli.console import console
from geoorbit_ros.cli.inputs import read_plane
from geoorbit_ros.cli.main import main
from geoorbit_ros.lanes.geojson import read_lanes

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Run:
    """Run the command in this process: exit code, standard output, standard error."""
    monkeypatch.setenv("COLUMNS", "120")

    def call(*words: object) -> tuple[int, str, str]:
        code = main([str(word) for word in words])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return call


def lanes_of(camera: CameraFiles, out: Path, *more: object) -> tuple[object, ...]:
    tracks = ("--tracks", camera.tracks, "--calibration", camera.calibration)
    return ("lanes", *tracks, "--out", out, *more)


@pytest.fixture(scope="module")
def found(camera: CameraFiles, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("found") / "lanes.geojson"
    report = out.with_name("report.html")
    assert main([str(w) for w in lanes_of(camera, out, "--report", report)]) == 0
    return out


def test_lanes_are_found_and_score_against_the_truth(
    camera: CameraFiles, found: Path, run: Run
) -> None:
    code, out, err = run("score", found, camera.truth, "--json", "--require")
    score = json.loads(out)
    assert (code, err) == (0, "")
    assert (score["confirmed"], score["invented"], score["missed"]) == (2, [], [])
    assert score["centerline_mean_m"] < 0.2
    data = json.loads(found.read_text(encoding="utf-8"))
    assert data["geoorbit"]["camera_id"] == camera.folder.name
    assert found.with_name("report.html").stat().st_size > 10_000


def painted_road(camera: CameraFiles, folder: Path) -> tuple[Path, np.ndarray]:
    """An image with a white line on every true boundary, and its file."""
    plane = read_plane(camera.calibration)
    image = image_with_lines(plane, read_lanes(camera.truth, plane.datum).lanes)
    cv2.imwrite(str(folder / "road.png"), image)
    return folder / "road.png", image


def edges_of(path: Path) -> list[str]:
    features = json.loads(path.read_text(encoding="utf-8"))["features"]
    return [
        f["properties"].get("boundary_source", "") for f in features
        if f["properties"]["role"] != "centerline"
    ]  # fmt: skip


def test_boundaries_follow_the_lines_of_an_image(
    camera: CameraFiles, found: Path, tmp_path: Path, run: Run
) -> None:
    road, _ = painted_road(camera, tmp_path)
    out, page = tmp_path / "painted.geojson", tmp_path / "report.html"
    code, said, _ = run(*lanes_of(camera, out, "--image", road, "--report", page))
    assert code == 0
    assert "4 of 4 lane boundaries follow a painted line" in " ".join(said.split())
    assert edges_of(out) == ["paint"] * 4
    scores = [json.loads(run("score", f, camera.truth, "--json")[1]) for f in (found, out)]
    assert scores[1]["centerline_mean_m"] < min(scores[0]["centerline_mean_m"], 0.12)
    assert abs(scores[1]["lanes"][0]["width_error_m"]) < 0.06
    assert "white line, solid" in page.read_text(encoding="utf-8")
    assert "4 of 4 lane boundaries follow a painted line" in page.read_text(encoding="utf-8")
    again = tmp_path / "again.geojson"
    run(*lanes_of(camera, again, "--image", road))
    assert again.read_bytes() == out.read_bytes()


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda image: image[:, :1080], "is not of this camera"),
        (lambda image: np.zeros_like(image), "of one brightness (0 to 0 of 255)"),
        (lambda image: np.full_like(image, 255), "of one brightness (255 to 255 of 255)"),
        (lambda image: cv2.GaussianBlur(image, (0, 0), 40), "boundaries are where the traffic"),
        (lambda image: np.ascontiguousarray(image[::-1]), "boundaries are where the traffic"),
    ],
)
def test_an_image_that_shows_no_lines_leaves_the_lanes_of_the_traffic(
    camera: CameraFiles,
    found: Path,
    tmp_path: Path,
    run: Run,
    change: Callable[[np.ndarray], np.ndarray],
    told: str,
) -> None:
    road, image = painted_road(camera, tmp_path)
    cv2.imwrite(str(road), change(image))
    out = tmp_path / "lanes.geojson"
    code, said, _ = run(*lanes_of(camera, out, "--image", road))
    assert code == 0
    assert told in " ".join(said.split())
    assert "paint" not in edges_of(out)
    before, after = (read_lanes(path) for path in (found, out))
    for old, new in zip(before.lanes, after.lanes, strict=True):
        assert np.array_equal(old.centerline_m, new.centerline_m)


def test_an_image_of_another_size_of_the_same_view_will_do(
    camera: CameraFiles, tmp_path: Path, run: Run
) -> None:
    road, image = painted_road(camera, tmp_path)
    cv2.imwrite(str(road), cv2.resize(image, (1280, 720), interpolation=cv2.INTER_AREA))
    out = tmp_path / "lanes.geojson"
    assert run(*lanes_of(camera, out, "--image", road))[0] == 0
    assert edges_of(out) == ["paint"] * 4


def test_boxes_are_in_the_pixels_of_the_image_where_nobody_says_another_size(
    camera: CameraFiles, tmp_path: Path, run: Run
) -> None:
    """The same camera with images half as large."""
    _, image = painted_road(camera, tmp_path)
    half = tmp_path / "half.png"
    cv2.imwrite(str(half), cv2.resize(image, (960, 540), interpolation=cv2.INTER_AREA))
    files = {}
    for name, source, columns in (
        ("tracks", camera.tracks, ("x", "y", "w", "h")),
        ("calibration", camera.calibration, ("pixel_x", "pixel_y")),
    ):
        files[name] = tmp_path / f"{name}.csv"
        with source.open(encoding="utf-8") as old, files[name].open("w", encoding="utf-8") as new:
            comments = [line for line in old if line.startswith("#")]
            old.seek(0)
            rows = csv.DictReader(line for line in old if not line.startswith("#"))
            new.writelines(comments)
            writer = csv.DictWriter(new, rows.fieldnames or ())
            writer.writeheader()
            writer.writerows(
                row | {k: f"{0.5 * float(row[k]):.4f}" for k in columns} for row in rows
            )
    out = tmp_path / "lanes.geojson"
    words = ("--tracks", files["tracks"], "--calibration", files["calibration"], "--out", out)
    code, said, _ = run("lanes", *words, "--image", half)
    assert code == 0
    assert "is the image really" not in said
    assert edges_of(out) == ["paint"] * 4
    half.rename(tmp_path / "road.png")  # as `geoorbit process` leaves it beside the tracks
    assert run("lanes", *words, "--image-size", "960x540")[0] == 0
    of_size = out.read_bytes()
    assert run("lanes", *words)[0] == 0
    assert out.read_bytes() == of_size


def test_tables_fit_in_a_terminal_of_80_columns(
    camera: CameraFiles, found: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console, "width", 80)
    for words in (lanes_of(camera, tmp_path / "l.geojson"), ("score", found, camera.truth)):
        code, out, _ = run(*words)
        assert code == 0
        assert "confirmed" in out
        assert "…" not in out


def test_lanes_prints_a_row_per_lane(camera: CameraFiles, tmp_path: Path, run: Run) -> None:
    code, out, _ = run(*lanes_of(camera, tmp_path / "l.geojson"))
    assert code == 0
    assert len(re.findall(r"confirmed +E +\d+°", out)) == 2
    assert "2 lanes confirmed (2 towards E)." in out


def test_the_same_tracks_give_the_same_bytes(
    camera: CameraFiles, found: Path, tmp_path: Path, run: Run
) -> None:
    again = tmp_path / "lanes.geojson"
    run(*lanes_of(camera, again, "--report", tmp_path / "report.html"))
    assert again.read_bytes() == found.read_bytes()
    report = found.with_name("report.html")
    assert (tmp_path / "report.html").read_bytes() == report.read_bytes()


def test_score_table_says_what_is_missed(
    camera: CameraFiles, found: Path, tmp_path: Path, run: Run
) -> None:
    data = json.loads(found.read_text(encoding="utf-8"))
    gone = data["features"][0]["properties"]["lane_id"]
    data["features"] = [f for f in data["features"] if f["properties"]["lane_id"] != gone]
    one = tmp_path / "one.geojson"
    one.write_text(json.dumps(data), encoding="utf-8")
    code, out, _ = run("score", one, camera.truth)
    assert code == 0
    assert "1 of 2 lanes found" in out
    assert "missed" in out
    assert run("score", one, camera.truth, "--require")[0] == 1
    code, out, _ = run("score", found, one, "--require")
    assert code == 1
    assert "1 invented" in out


def test_report_draws_given_lanes_and_scores_them(
    camera: CameraFiles, found: Path, tmp_path: Path, run: Run
) -> None:
    out = tmp_path / "report.html"
    tracks = ("--tracks", camera.tracks, "--calibration", camera.calibration)
    code, _, _ = run("report", *tracks, "--lanes", found, "--truth", camera.truth, "--out", out)
    page = out.read_text(encoding="utf-8")
    assert code == 0
    assert "Compared with the true lanes" in page
    assert "2 of 2 lanes found" in page


# Wrong input: what to break, and the words the sentence must have.


def edited(path: Path, folder: Path, change: Callable[[list[str]], list[str]]) -> Path:
    lines = path.read_text(encoding="utf-8").splitlines()
    broken = folder / f"broken{path.suffix}"
    broken.write_text("\n".join(change(lines)) + "\n", encoding="utf-8")
    return broken


Change = Callable[[list[str]], list[str]]
FAULTY: list[tuple[str, Change, str]] = [
    (
        "no number",
        lambda x: [*x[:5], re.sub(r",2,0\.9,[^,]+", ",2,0.9,nan", x[5]), *x[6:]],
        "left out: a position or size that is no number (first: line 6",
    ),
    (
        "a word",
        lambda x: [*x[:3], x[3].replace(",0.9,", ",sure,"), *x[4:]],
        "repaired: a score that is no number; taken as sure (first: line 4)",
    ),
    (
        "back in time",
        lambda x: [x[0], *x[-20:], *x[1:-20]],
        "repaired: not in the order of time; they are sorted (first: line 22)",
    ),
    (
        "cut short",
        lambda x: [*x[:-1], x[-1][:12]],
        "left out: not 9 values as in the header",
    ),
]
TRACKS: list[tuple[str, Change, tuple[str, ...]]] = [
    ("missing column", lambda x: [x[0].replace("id,", "number,"), *x[1:]], ("ids", "--columns")),
    ("no rows", lambda x: x[:1], ("broken.csv",)),
    (
        "people",
        lambda x: [x[0], *(",".join((*r.split(",")[:3], "0", *r.split(",")[4:])) for r in x[1:])],
        ("of class 0 only", "2 (car)"),
    ),
]
POINTS: list[tuple[str, Callable[[list[str]], list[str]], tuple[str, ...]]] = [
    ("three points", lambda x: x[:4], ("3 control points", "at least 4")),
    ("on one line", lambda x: [x[0], *x[1::3]], ("line",)),
    (
        "mirrored",
        lambda x: [x[0], *(",".join((*r.split(",")[1::-1], *r.split(",")[2:])) for r in x[1:])],
        ("pixel_x and pixel_y, swapped?",),
    ),
    ("no header", lambda x: x[1:], ("line 1", "pixel_x")),
]


def check_refusal(result: tuple[int, str, str], out: Path, words: tuple[str, ...]) -> None:
    code, _, err = result
    assert code == 2
    assert err.startswith("geoorbit: ")
    assert err.count("\n") == 1
    assert "Traceback" not in err
    for word in words:
        assert word in err
    assert list(out.parent.iterdir()) == [], "partial output"


@pytest.mark.parametrize(("change", "words"), [t[1:] for t in TRACKS], ids=[t[0] for t in TRACKS])
def test_wrong_tracks(
    camera: CameraFiles, tmp_path: Path, run: Run, change: Any, words: tuple[str, ...]
) -> None:
    folder, out = tmp_path / "in", tmp_path / "out" / "lanes.geojson"
    folder.mkdir()
    out.parent.mkdir()
    tracks = ("--tracks", edited(camera.tracks, folder, change))
    result = run("lanes", *tracks, "--calibration", camera.calibration, "--out", out)
    check_refusal(result, out, words)


@pytest.mark.parametrize(("change", "words"), [t[1:] for t in FAULTY], ids=[t[0] for t in FAULTY])
def test_faulty_rows_are_told_in_table_and_report_and_refused_when_strict(
    camera: CameraFiles, found: Path, tmp_path: Path, run: Run, change: Change, words: str
) -> None:
    folder, out = tmp_path / "in", tmp_path / "out" / "lanes.geojson"
    folder.mkdir()
    out.parent.mkdir()
    points = ("--calibration", camera.calibration)
    tracks = ("--tracks", edited(camera.tracks, folder, change))
    check_refusal(
        run("lanes", *tracks, *points, "--out", out, "--strict"), out, (words, "--strict")
    )
    page = tmp_path / "report.html"
    code, shown, err = run("lanes", *tracks, *points, "--out", out, "--report", page)
    assert (code, err) == (0, "")
    assert words in " ".join(shown.split())
    assert words in page.read_text(encoding="utf-8")
    assert run("score", out, found, "--require")[0] == 0


def test_tracks_left_out_for_their_class_are_counted_and_named(
    camera: CameraFiles, tmp_path: Path, run: Run
) -> None:
    tracks = edited(
        camera.tracks,
        tmp_path,
        lambda x: [x[0], *(re.sub(r"^(1|2),(.*?),2,", r"\1,\2,0,", r) for r in x[1:])],
    )
    command = ("lanes", "--tracks", tracks, "--calibration", camera.calibration)
    code, shown, _ = run(*command, "--out", tmp_path / "some.geojson")
    assert code == 0
    words = "tracks make no lane, as they are no motor vehicles: 2 of class 0 (person)"
    assert words in " ".join(shown.split())
    code, shown, _ = run(*command, "--out", tmp_path / "all.geojson", "--classes", "0=car,2=truck")
    assert code == 0
    assert "make no lane" not in shown


@pytest.mark.parametrize(("change", "words"), [t[1:] for t in POINTS], ids=[t[0] for t in POINTS])
def test_wrong_calibration(
    camera: CameraFiles, tmp_path: Path, run: Run, change: Any, words: tuple[str, ...]
) -> None:
    folder, out = tmp_path / "in", tmp_path / "out" / "lanes.geojson"
    folder.mkdir()
    out.parent.mkdir()
    points = ("--calibration", edited(camera.calibration, folder, change))
    check_refusal(run("lanes", "--tracks", camera.tracks, *points, "--out", out), out, words)


def test_a_camera_with_no_traffic(camera: CameraFiles, tmp_path: Path, run: Run) -> None:
    folder, out = tmp_path / "in", tmp_path / "out" / "lanes.geojson"
    folder.mkdir()
    out.parent.mkdir()

    def parked(lines: list[str]) -> list[str]:
        cells = lines[20].split(",")
        return [lines[0], *(",".join(("1", f"{k / 10}", str(k), *cells[3:])) for k in range(200))]

    tracks = ("--tracks", edited(camera.tracks, folder, parked))
    result = run("lanes", *tracks, "--calibration", camera.calibration, "--out", out)
    check_refusal(result, out, ("broken.csv", "vehicles driving by"))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--image-size", "big"), ("--image-size", "'big'", "1920x1080")),
        (("--datum", "43"), ("--datum", "'43'", "LATITUDE,LONGITUDE")),
        (("--datum", "95,0"), ("--datum", "'95,0'")),
    ],
)
def test_wrong_options(
    camera: CameraFiles,
    tmp_path: Path,
    run: Run,
    options: tuple[str, ...],
    words: tuple[str, ...],
) -> None:
    out = tmp_path / "lanes.geojson"
    check_refusal(run(*lanes_of(camera, out, *options)), out, words)


def test_tracks_or_bag_but_not_both_or_neither(
    camera: CameraFiles, tmp_path: Path, run: Run
) -> None:
    out = tmp_path / "lanes.geojson"
    for source in ((), ("--tracks", camera.tracks, "--bag", tmp_path)):
        result = run("lanes", *source, "--calibration", camera.calibration, "--out", out)
        check_refusal(result, out, ("--tracks and --bag", "exactly one"))


def test_points_in_metres_need_a_datum(camera: CameraFiles, tmp_path: Path, run: Run) -> None:
    metres = tmp_path / "in.csv"
    metres.write_text("pixel_x,pixel_y,x_m,y_m\n100,900,0,0\n1800,900,10,0\n1100,400,12,60\n"
                      "800,400,0,60\n", encoding="utf-8")  # fmt: skip
    out = tmp_path / "out" / "lanes.geojson"
    out.parent.mkdir()
    result = run("lanes", "--tracks", camera.tracks, "--calibration", metres, "--out", out)
    check_refusal(result, out, ("in.csv", "metres", "--datum"))


def test_an_input_is_never_overwritten(tmp_path: Path, camera: CameraFiles, run: Run) -> None:
    tracks = tmp_path / "tracks.csv"
    write_tracks(tracks, 3)
    before = tracks.read_bytes()
    for command in ("lanes", "report"):
        source = ("--tracks", tracks, "--calibration", camera.calibration)
        code, _, err = run(command, *source, "--out", tracks)
        assert code == 2
        assert "tracks.csv" in err
    assert tracks.read_bytes() == before


def test_score_of_a_file_that_is_none(camera: CameraFiles, tmp_path: Path, run: Run) -> None:
    code, out, err = run("score", tmp_path / "absent.geojson", camera.truth)
    assert (code, out) == (2, "")
    assert "absent.geojson: found No such file" in err
