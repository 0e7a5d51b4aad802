"""Output that is there completely or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from geoorbit_ros.core.errors import InputFileError


@contextmanager
def atomic_output(path: str | Path, *, overwrite: bool = False) -> Iterator[Path]:
    """Write a file or a folder under a temporary path, then rename it to `path`.

    The temporary path lies in a hidden folder beside `path` (same file system, so the rename is
    atomic) and ends in the same name, because some writers name things inside after it. Missing
    parent folders are made, and taken away again when the block fails.

    A device or a pipe (`/dev/stdout`, `/dev/null`) is not replaced: the result is written into it
    when it is complete.

    Args:
        path: Where the result goes. An existing file is replaced.
        overwrite: Also write into an existing folder with content: what has the same name is
            replaced, everything else stays. Without it that is refused before any work is done.

    Yields:
        The path to write to; nothing exists there yet.

    Raises:
        InputFileError: `path` is a folder with content and `overwrite` is off, or nothing can be
            written there.
    """
    target = Path(path).absolute()
    if target.exists() and not (target.is_file() or target.is_dir()):
        with _written_through(target) as temporary:
            yield temporary
        return
    if not overwrite and target.is_dir() and any(target.iterdir()):
        expected = "a path that does not exist yet (or --force)"
        raise InputFileError(str(path), "a folder with content", expected)
    made: list[Path] = []
    try:
        for folder in [*reversed(target.parent.parents), target.parent]:
            if not folder.exists():
                folder.mkdir()
                made.append(folder)
        scratch = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
    except OSError as error:
        _remove_empty(made)
        raise InputFileError(
            str(path), f"{error.strerror} ({error.filename})", "a place that can be written to"
        ) from None
    temporary = scratch / target.name
    try:
        yield temporary
        _sync(temporary)
        if temporary.is_dir() and target.is_dir():
            for entry in sorted(temporary.iterdir()):
                _put(entry, target / entry.name, scratch)
        else:
            _put(temporary, target, scratch)
    except BaseException as error:
        shutil.rmtree(scratch, ignore_errors=True)
        _remove_empty(made)
        if isinstance(error, OSError):
            _name_target(error, temporary, target)
        raise
    shutil.rmtree(scratch, ignore_errors=True)


@contextmanager
def _written_through(target: Path) -> Iterator[Path]:
    """A temporary file whose content goes into a device or pipe at the end."""
    with tempfile.TemporaryDirectory() as folder:
        temporary = Path(folder) / target.name
        yield temporary
        if temporary.is_dir():
            raise InputFileError(str(target), "a device or a pipe", "a folder, for several files")
        try:
            with temporary.open("rb") as source, target.open("wb") as sink:
                shutil.copyfileobj(source, sink)
        except OSError as error:
            found = error.strerror or str(error)
            raise InputFileError(str(target), found, "a place that can be written to") from None


def _name_target(error: OSError, temporary: Path, target: Path) -> None:
    """Let an error of the system name what the user asked for, not the temporary path.

    A full disk is met while an open file is written: such an error names no file at all.
    """
    if error.errno is None:
        return
    if error.filename is None:
        error.filename = str(target)
    elif isinstance(error.filename, str) and Path(error.filename).is_relative_to(temporary):
        error.filename = str(target / Path(error.filename).relative_to(temporary))


def _sync(path: Path) -> None:
    """Bring a file's content to disk before its name points at it (power loss, not kill)."""
    if path.is_file():
        with path.open("rb") as file:
            os.fsync(file.fileno())


def _put(source: Path, target: Path, scratch: Path) -> None:
    """Rename; rename(2) refuses to replace folders with content and mixed kinds: those go aside."""
    if target.is_dir() or (source.is_dir() and target.exists()):
        aside = scratch / "replaced"
        aside.mkdir(exist_ok=True)
        os.replace(target, aside / target.name)
    os.replace(source, target)


def _remove_empty(folders: list[Path]) -> None:
    for folder in reversed(folders):
        with suppress(OSError):  # another process has put something there: then it stays
            folder.rmdir()
