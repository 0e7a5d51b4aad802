"""A signal at any moment of the start ends a program without a traceback."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from made_up_camera import MadeUpCamera

from geoorbit_ros.nodes.support.composition import DomainClaim

pytestmark = pytest.mark.slow

REPOSITORY = Path(__file__).parents[2]
LIMIT_S = 120.0
MOMENTS = 6
"""How many processes of a program are told to end, each a step later than the one before."""
STEP_S = 0.3
"""Chosen: with `MOMENTS`, over the whole start and a little longer on a machine that is idle."""
LOG_LINE = re.compile(r"\[(INFO|WARN)\] ")


def handles_sigterm(process: subprocess.Popen[str]) -> bool:
    """Whether the program's first line has run: Python by itself leaves SIGTERM to the system."""
    status = Path(f"/proc/{process.pid}/status").read_text()
    caught = re.search(r"^SigCgt:\s*(\w+)$", status, re.MULTILINE)
    return caught is not None and bool(int(caught[1], 16) >> (signal.SIGTERM - 1) & 1)


@pytest.fixture
def domain_id() -> Iterator[int]:
    """A domain of its own: a second node of one name says so and ends."""
    claim = DomainClaim()
    yield claim.domain_id
    claim.close()


@pytest.fixture
def programs(camera: MadeUpCamera, tmp_path: Path) -> dict[str, list[str]]:
    module = [sys.executable, "-m"]
    node = {"executable": "homography", "parameters": {"calibration_file": str(camera.calibration)}}
    plan = tmp_path / "plan.json"
    plan.write_text(json.dumps({"name": "north", "first": False, "nodes": [node]}))
    replay = [str(camera.bag), "--calibration", str(camera.calibration), "--rate", "0.1"]
    command = [*module, "geoorbit_ros.cli.main"]
    return {
        "executable": [
            *(sys.executable, str(REPOSITORY / "scripts" / "bag_player")),
            *("--ros-args", "-p", f"bag:={camera.bag}"),
        ],
        "module": [*module, "geoorbit_ros.nodes.detector"],
        "group": [*module, "geoorbit_ros.nodes.support.fleet_process", str(plan), "1"],
        "command": [*command, "replay", *replay, "--out", str(tmp_path / "out" / "lanes.geojson")],
        "watching command": [*command, "status"],
    }


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize(
    "program", ["executable", "module", "group", "command", "watching command"]
)
def test_a_signal_at_any_moment_of_the_start(
    program: str,
    number: signal.Signals,
    programs: dict[str, list[str]],
    domain_id: int,
    tmp_path: Path,
) -> None:
    (tmp_path / "out").mkdir()
    environment = os.environ | {
        "PYTHONPATH": str(REPOSITORY),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_DOMAIN_ID": str(domain_id),
    }
    for moment in range(MOMENTS):
        with subprocess.Popen(
            programs[program],
            env=environment,
            cwd=tmp_path,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        ) as process:
            try:
                deadline = time.monotonic() + LIMIT_S
                while not handles_sigterm(process):
                    assert process.poll() is None
                    assert time.monotonic() < deadline
                with pytest.raises(subprocess.TimeoutExpired):
                    process.wait(moment * STEP_S)
                process.send_signal(number)
                said = process.communicate(timeout=LIMIT_S)[1]
            finally:
                process.kill()
        lines = [line for line in said.splitlines() if line and not LOG_LINE.match(line)]
        assert process.returncode in (0, 130), said
        assert len(lines) <= 1, said
        assert list((tmp_path / "out").iterdir()) == []


STUCK = """
import ctypes, sys
from geoorbit_ros.nodes.support import process
from geoorbit_ros.nodes.tracker import TrackerNode

class Stuck(TrackerNode):
    def __init__(self):
        super().__init__()
        self.told = self.create_timer(0.01, self.tell)

    def tell(self):
        self.destroy_timer(self.told)
        print("spinning", flush=True)

    def destroy_node(self):
        print("destroying", flush=True)
        ctypes.PyDLL(None).sleep(600)  # with the interpreter's lock, as the middleware does

process.LEAVE_LIMIT_S = 3.0
sys.exit(process.run_node(Stuck))
"""


def test_a_middleware_that_never_lets_go_keeps_no_node(domain_id: int) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", STUCK],
        env=os.environ | {"ROS_DOMAIN_ID": str(domain_id)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "spinning\n"
        process.send_signal(signal.SIGINT)
        output = process.communicate(timeout=LIMIT_S)[0]
    finally:
        process.kill()
    assert (process.returncode, output) == (0, "destroying\n")
