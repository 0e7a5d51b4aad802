"""Every example of the README and the guides runs as it stands there, in the order of the page.

Times and sizes of simulated cameras are reduced (`SHORTER`). What can't run here is listed with the
reason (`NOT_HERE`); a new example that fits neither fails.
"""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from made_models import red_finder
from typer.main import get_command

from geoorbit_ros.cli.app import app
from geoorbit_ros.cli.main import main
from geoorbit_ros.conversions import decode_table, encode_table
from geoorbit_ros.core.tables import PIXEL_TRACK_DTYPE, TRACK_DTYPE

REPOSITORY = Path(__file__).parents[2]

SHORTER = {
    "scene render off_ramp_diverge --duration 60": "scene render off_ramp_diverge --duration 12",
    "--duration 60": "--duration 20",
    "--size 1280x720 --fps 25": "--size 640x360 --fps 10",
    "--size 960x540": "--size 640x360",
    "scene render on_ramp_merge --size": "scene render on_ramp_merge --duration 12 --size",
    "--rounds 20": "--rounds 1 --workers 1",
    "--strategy cautious": "--rounds 1 --workers 1 --strategy cautious",
    "--net area/": "--net out/camera/",  # the pages' area has no camera
}

NOT_HERE = {
    r"ros2 |rosdep |colcon |fastdds ": "needs a ROS installation; test_install, test_wiring do it",
    r"python3 -m pip|pip install|git clone": "installs packages, or this repository",
    r"\./dev (demo|test|check|docs|bench)": "test_demo, test_dev; this is ./dev test",
    r"\.venv/bin/fast-discovery-server": "runs until it is ended: test_namespaces",
    r"export |P=": "sets a variable for ros2",
    r"\./dev run (up|status|view) |geoorbit (up|status|view) ": "run until ended: test_fleet",
    r"\./dev run calibrate rtsp:": "a network camera",
    r"(\./dev run camera add|geoorbit process) rtsp:": "a network camera: test_camera_process",
    r"GEOORBIT_REAL_DATA=|\./dev run evaluate --out out/roads": "a study of hours",
}

SCENE = "scene run on_ramp_merge --duration 20 --seed 1 --out out/camera"
FILM = "scene render off_ramp_diverge --duration 12 --size 640x360 --fps 10 --out out/film"
LANES = (
    "lanes --tracks out/camera/tracks.csv --calibration out/camera/calibration.csv"
    " --out lanes.geojson"
)
RECORD = (
    "replay out/camera/bag --calibration out/camera/calibration.csv --rate 0"
    " --out lanes.geojson --database tracks.db"
)
GIVEN = {
    "docs/calibration.md": ["scene run motorway_4x4 --duration 60 --seed 1 --out out/camera"],
    "docs/cameras.md": [FILM],
    "docs/detection.md": [FILM],
    "docs/markings.md": [SCENE, "scene render on_ramp_merge --duration 2 --seed 1 --out out/film"],
    "docs/tracking.md": [FILM, "detect out/film/video.mp4 --out det.txt"],
    "docs/ros.md": [SCENE + " --camera-id north", RECORD],
    "docs/traffic.md": [SCENE],
    "docs/twin.md": [SCENE, LANES, RECORD.replace("lanes.geojson", "replayed.geojson")],
}  # fmt: skip
"""What a page says that its reader has."""

NAMED = {
    "north.mp4": "out/film/video.mp4",
    "calibration.csv": "out/film/calibration.csv",
    "north.csv": "out/camera/calibration.csv",
    "north_bag": "out/camera/bag",
}
"""Files that pages name, and what stands for them where there is one."""

STUDY = """
name: small
duration_s: 10
seen: {first: 3, count: 2}
unseen: {first: 20003, count: 1}
"""
"""Stands for params/studies/small.yaml, which takes minutes."""

PAGES = ["README.md", *(f"docs/{path.name}" for path in sorted((REPOSITORY / "docs").glob("*.md")))]


def blocks(page: str, language: str) -> list[str]:
    """Code blocks of one language."""
    text = (REPOSITORY / page).read_text(encoding="utf-8")
    found = re.findall(r"^```(\w*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    return [block for name, block in found if name == language]


def commands(page: str) -> list[str]:
    """Lines of the page's shell examples, continued lines joined, without comments."""
    text = "".join(blocks(page, "sh")).replace("\\\n", " ")
    lines = (re.sub(r"(^|\s)#.*", "", line).strip() for line in text.splitlines())
    return [line for line in lines if line]


def not_here(command: str) -> bool:
    return any(re.match(pattern, command) for pattern in NOT_HERE)


_made: dict[str, Path] = {}


def run_once(arguments: list[str]) -> None:
    """Run a command in the current folder, or copy what the same scene gave another page."""
    scene = arguments[0] == "scene" and "--out" in arguments
    at = arguments.index("--out") + 1 if scene else len(arguments)
    same = shlex.join(arguments[:at] + arguments[at + 1 :])
    if same in _made:
        shutil.copytree(_made[same], arguments[at])
        return
    assert main(arguments) == 0, shlex.join(arguments)
    if scene:
        _made[same] = Path(arguments[at]).resolve()


def prepare(page: str) -> None:
    """What the reader of the page has, in the current folder."""
    shutil.copytree(REPOSITORY / "params", "params")
    Path("params/studies/small.yaml").write_text(STUDY, encoding="utf-8")
    for command in GIVEN.get(page, []):
        run_once(shlex.split(command))
    for name, source in NAMED.items():
        if Path(source).exists():
            Path(name).symlink_to(source)
    names: dict[str, object] = {"names": {0: "car", 1: "bus"}}
    red_finder(Path("yolo11n.onnx"), "raw", (640, 640), 8400, names)
    nodes = "".join(
        f'<node id="{k}" visible="true" version="1" lat="48.1" lon="{11.6 + 0.002 * k}"/>'
        for k in (1, 2)
    )
    way = '<way id="9" version="1"><nd ref="1"/><nd ref="2"/><tag k="highway" v="primary"/></way>'
    Path("area.osm").write_text(f'<?xml version="1.0"?><osm version="0.6">{nodes}{way}</osm>')
    for block in [*blocks(page, "python"), *blocks(page, "csv")]:
        if file := re.match(r"# (\w+\.(?:py|csv))\n", block):
            Path(file[1]).write_text(block, encoding="utf-8")


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_shell_examples_run(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = [command for command in commands(page) if not not_here(command)]
    if not run:
        return
    monkeypatch.chdir(tmp_path)
    prepare(page)
    for command in run:
        for long, short in SHORTER.items():
            command = command.replace(long, short)
        program, *arguments = shlex.split(re.sub(r"^\./dev run ", "geoorbit ", command))
        if program == "geoorbit":
            run_once(arguments)
        else:
            assert program == "cmp", f"{page}: {command}: add it to NOT_HERE with the reason"
            done = subprocess.run([program, *arguments], capture_output=True, check=False)
            assert (done.returncode, done.stdout) == (0, b""), command


@pytest.mark.parametrize("page", PAGES)
def test_options_of_examples_that_do_not_run_exist(page: str) -> None:
    """An example that can't run here is parsed: unknown and missing options are found."""
    for example in filter(not_here, commands(page)):
        words = shlex.split(re.sub(r"^(\w+=\S+ )*\./dev run ", "geoorbit ", example))
        if words[0] == "geoorbit":
            command, arguments = get_command(app), words[1:]
            while names := getattr(command, "commands", {}):
                name, *arguments = arguments
                command = names[name]
            with command.make_context(example, arguments):
                pass


@pytest.mark.parametrize("page", PAGES)
def test_python_examples_run(page: str) -> None:
    given = {"cdr_bytes": encode_table(1, "map", np.zeros(2, TRACK_DTYPE))}
    for block in blocks(page, "python"):
        made: dict[str, object] = dict(given)
        exec(compile(block, page, "exec"), made)
        if isinstance(cdr := made.get("cdr"), bytes):  # the message of the first guide
            stamp_ns, frame, rows = decode_table(cdr, PIXEL_TRACK_DTYPE, "here")
            assert (stamp_ns, frame, len(rows)) == (made["stamp_ns"], "north_optical_frame", 1)


def test_every_reason_is_needed() -> None:
    every = [command for page in PAGES for command in commands(page)]
    assert [p for p in NOT_HERE if not any(re.match(p, command) for command in every)] == []
