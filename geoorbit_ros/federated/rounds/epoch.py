"""The number of a federation's run: it only grows, also where a checkpoint or the time was lost.

Clients refuse what is of an earlier run than they know. The number is the time at which the
run began, and so would be too small once the clock was set back. It is kept in a small file beside
the server's key, apart from the checkpoint.
"""

from __future__ import annotations

from pathlib import Path

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.state_file import StateFile
from geoorbit_ros.federated.errors import FederationError

MAX_RUN = 2**32 - 1
"""Runs are 32 bits wide in payloads."""


class Epochs:
    """Gives numbers to runs.

    Args:
        file: Where the last one is kept; None: nowhere, and only the clock makes it grow.

    Attributes:
        told: What was wrong with the file, in sentences.
    """

    def __init__(self, file: Path | None) -> None:
        self._state = StateFile(file, "the number of a federation's run") if file else None
        self._last = (self._state.read(_number) if self._state else None) or 0
        self.told = self._state.told if self._state else []

    def next(self, now_s: int, known: int = 0) -> int:
        """The number of a run that begins now.

        Args:
            now_s: Seconds since 1970, by whatever clock.
            known: The run before, as far as somebody knows.

        Raises:
            FederationError: There are no more numbers.
        """
        run = max(now_s, known + 1, self._last + 1)
        if run > MAX_RUN:
            raise FederationError("run", run, f"{MAX_RUN} at most: set this computer's clock")
        return run

    def note(self, run: int) -> None:
        """Keep the number before anybody hears it.

        Raises:
            InputFileError: It can't be written.
        """
        if self._state and run > self._last:
            self._state.write(f"{run}\n".encode())
            self._last = run


def _number(path: Path) -> int:
    run = int(path.read_text(encoding="ascii"))
    if not 0 <= run <= MAX_RUN:
        raise InputFileError(str(path), run, "a run")
    return run
