"""One owner at a time; a killed one leaves nothing in the way."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.storage.ownership import Ownership

HOLD = """
import sys, pathlib
from geoorbit_ros.storage.ownership import Ownership
held = Ownership(pathlib.Path(sys.argv[1]), "the folder")
print("held", flush=True)
sys.stdin.read()
"""


def test_the_second_owner_is_told_who_is_there_and_a_killed_one_is_gone(tmp_path: Path) -> None:
    lock = tmp_path / "a.lock"
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(lock)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[3],
    ) as other:
        try:
            assert other.stdout is not None
            assert other.stdout.readline() == "held\n"
            said = rf"the folder: found in use by process {other.pid} since 20\d\d-.*, expected one"
            with pytest.raises(InputFileError, match=said):
                Ownership(lock, "the folder")
        finally:
            other.send_signal(signal.SIGKILL)
    with Ownership(lock, "the folder"):
        assert f"process {os.getpid()} since" in lock.read_text()
        with pytest.raises(InputFileError, match="in use by process"):
            Ownership(lock, "the folder")
    Ownership(lock, "the folder").close()


def test_a_place_that_cant_be_written_to(tmp_path: Path) -> None:
    with pytest.raises(InputFileError, match="No such file or directory"):
        Ownership(tmp_path / "none" / "a.lock", "the folder")
