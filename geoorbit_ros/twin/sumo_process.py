"""Starts SUMO as a program of its own, with a TraCI connection."""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from geoorbit_ros.core.errors import GeoOrbitError


class SimulationError(GeoOrbitError):
    """SUMO did not start, refused something, or is gone."""


START_RETRIES, RETRY_S = 200, 0.1
"""Attempts to connect, and seconds between them: 20 s. Chosen: SUMO reads its network before it
answers; more waits longer for one that never does."""
CLOSE_TIMEOUT_S = 10.0
"""A SUMO that has not ended by then is killed. Chosen: larger delays the end of a node, smaller
cuts off the last files."""
ANSWER_TIMEOUT_S = 10.0
"""A SUMO that does not answer for this long counts as hung. Chosen: a step of thousands of vehicles
takes a second at most; larger leaves the twin standing longer."""
_LEAKED = ("LD_LIBRARY_PATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE")
"""Variables that the ROS wheels set for their own process; no other program may see them."""


def start_program(
    program: str, arguments: list[str], folder: Path
) -> tuple[subprocess.Popen[bytes], Any]:
    """Start `sumo` or `sumo-gui`; the process and its TraCI connection.

    Args:
        program: Name of the program.
        arguments: Its options.
        folder: Where its log goes.

    Raises:
        SimulationError: It is not installed, refuses its input or does not answer.
    """
    import sumolib

    path = program_path(program)
    port = sumolib.miscutils.getFreeSocketPort()
    gui = ["--start", "--quit-on-end"] if program == "sumo-gui" else []
    log = folder / "sumo.log"
    with log.open("wb") as output:
        process = subprocess.Popen(
            [path, *arguments, *gui, f"--remote-port={port}"],
            env=program_environment(),
            stdout=output,
            stderr=subprocess.STDOUT,
        )
    try:
        connection = _connect(port, process, log)
        if not gui:
            # A SUMO that hangs must not block the node; a window may be paused by its user.
            connection._socket.settimeout(ANSWER_TIMEOUT_S)  # noqa: SLF001, traci has no other way
        return process, connection
    except BaseException:
        process.kill()
        process.wait()
        raise


def program_path(program: str) -> str:
    """Path of one of SUMO's programs.

    Raises:
        SimulationError: It is not installed.
    """
    import sumolib

    path: str | None = shutil.which(sumolib.checkBinary(program))
    if path is None:
        raise SimulationError("SUMO", f"no program '{program}'", "pip install eclipse-sumo")
    return path


def program_environment() -> dict[str, str]:
    """This process's environment without the variables of `_LEAKED`."""
    return {key: value for key, value in os.environ.items() if key not in _LEAKED}


def _connect(port: int, process: subprocess.Popen[bytes], log: Path) -> Any:
    """A TraCI connection to a SUMO that has read its network; it listens before that."""
    import traci
    from traci.connection import Connection

    for _ in range(START_RETRIES):
        if process.poll() is not None:
            break
        try:
            connection = Connection("localhost", port, process, None, False, None)
            connection.getVersion()
            return connection
        except OSError:
            time.sleep(RETRY_S)
        except (traci.TraCIException, traci.FatalTraCIError):
            break
    else:
        found = f"no answer in {START_RETRIES * RETRY_S:g} s"
        raise SimulationError("SUMO", found, "a simulation")
    with suppress(subprocess.TimeoutExpired):
        process.wait(CLOSE_TIMEOUT_S)
    text = log.read_text(errors="replace").strip().splitlines()
    errors = [line for line in text if line.startswith("Error")] or text
    found = errors[0][:300] if errors else "an end without a message"
    raise SimulationError("SUMO", found, "a simulation")


def exit_text(code: int) -> str:
    """How a process ended."""
    return f"signal {-code}" if code < 0 else f"exit status {code}"


def first_line(error: BaseException) -> str:
    """The first line of an error, at most 300 characters."""
    lines = str(error).strip().splitlines()
    return lines[0][:300] if lines else type(error).__name__
