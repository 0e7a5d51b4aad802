"""One owner of a folder or a file: the second one is told who is there, and since when.

The lock is the kernel's (flock(2)): it ends with its process, however that ends, so nothing stale
is left to be cleaned up.
"""

from __future__ import annotations

import errno
import fcntl
import os
from datetime import datetime
from pathlib import Path
from typing import Self

from geoorbit_ros.core.errors import InputFileError

_NO_LOCKS = (errno.ENOLCK, errno.ENOTSUP)
"""Some network file systems have no locks; there, nobody can be told."""


class Ownership:
    """Holds a lock file until it is closed, or its process ends.

    Args:
        file: The lock file; it is made, and stays. Its folder must be there.
        place: What is owned, for the error.

    Raises:
        InputFileError: Another process holds it, or the file can't be written.
    """

    def __init__(self, file: Path, place: str) -> None:
        try:
            self._file = file.open("a+", encoding="utf-8")
        except OSError as error:
            found = error.strerror or str(error)
            raise InputFileError(str(file), found, "a place that can be written to") from None
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in _NO_LOCKS:
                return
            self._file.seek(0)
            owner = self._file.read().strip() or "another process"
            self._file.close()
            raise InputFileError(
                place, f"in use by {owner}", "one owner; end that one first"
            ) from None
        self._file.truncate(0)
        since = datetime.now().astimezone().isoformat(" ", "seconds")
        self._file.write(f"process {os.getpid()} since {since}\n")
        self._file.flush()

    def close(self) -> None:
        """Give it up."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
