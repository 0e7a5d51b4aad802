"""A camera process beside a network camera that has died."""

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
LIMIT_S = 120.0
OPEN_S, STOP_S = 60.0, 45.0
"""An opening of the stream takes longer than the end is waited for: the signal cuts it short."""


def start(source: str) -> subprocess.Popen[str]:
    words = [sys.executable, "-m", "geoorbit_ros.nodes.camera", "--ros-args"]
    words += ["-r", "__ns:=/north", "-p", f"source:={source}", "-p", f"open_timeout_s:={OPEN_S}"]
    environment = os.environ | {
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "PYTHONPATH": str(REPOSITORY),
    }
    return subprocess.Popen(
        words, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_camera_ends_when_told_to_though_its_stream_never_answers(number: signal.Signals) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(LIMIT_S)
        process = start(f"http://127.0.0.1:{server.getsockname()[1]}/stream")
        try:
            connection, _ = server.accept()  # and then not a word
            process.send_signal(number)
            _, error = process.communicate(timeout=STOP_S)
        finally:
            process.kill()
        connection.close()
    assert process.returncode == 0
    assert "Traceback" not in error


def test_a_video_that_is_not_there_is_one_sentence_and_status_2() -> None:
    process = start("/nowhere/north.mp4")
    _, error = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 2
    assert error.startswith("/nowhere/north.mp4: found no such file, expected a video")
    assert error.count("\n") == 1
