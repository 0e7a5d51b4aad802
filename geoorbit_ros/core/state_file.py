"""What a process keeps for its next start: two generations, and a broken one is set aside."""

from __future__ import annotations

import os
import shutil
import struct
import zipfile
import zlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from geoorbit_ros.core.errors import GeoOrbitError, InputFileError

UNREADABLE = (
    OSError,
    EOFError,
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    NotImplementedError,
    MemoryError,
    RecursionError,
    OverflowError,
    struct.error,
    zlib.error,
    zipfile.BadZipFile,
)
"""What readers of arrays and JSON raise for bytes that are none."""
MAX_STATE_BYTES = 1 << 30
"""Longest file. Chosen: ten times the largest state; this program wrote no longer one."""

Value = TypeVar("Value")


class NewerStateError(InputFileError):
    """A state that a newer version wrote: it is sound, and so is never set aside."""


class StateFile:
    """A file that is replaced as a whole; the one before stays beside it, as `NAME.previous`.

    After a crash at any moment the file is the old one or the new one. A file that can't be read is
    renamed to `NAME.damaged`, and the one before is used: a state is never a reason not to start.
    Who deletes the file begins anew, whatever is beside it.

    Args:
        path: The file; its folder is made with the first writing.
        kind: What it is, for errors: `a saved lane map`.

    Attributes:
        told: What was set aside, in sentences.
        fell_back: Whether the last reading gave the generation before, as the newest was broken.
    """

    def __init__(self, path: Path, kind: str) -> None:
        self.path, self._kind = path, kind
        self.told: list[str] = []
        self.fell_back = False

    @property
    def previous(self) -> Path:
        """The generation before."""
        return self.path.with_name(f"{self.path.name}.previous")

    def write(self, content: bytes, *, sync: bool = True) -> None:
        """Replace the file; only its owner can read it.

        Args:
            content: All of it.
            sync: Whether it must outlast a loss of power, which waits for the disk; else it
                outlasts the death of the process.

        Raises:
            InputFileError: It can't be written; both generations are as before.
        """
        scratch = self.path.with_name(f".{self.path.name}.new")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with suppress(FileNotFoundError):  # of a process that was killed
                scratch.unlink()
            handle = os.open(scratch, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            with os.fdopen(handle, "wb") as stream:
                stream.write(content)
                stream.flush()
                if sync:
                    os.fsync(stream.fileno())
            self._keep_previous()
            scratch.replace(self.path)
            if sync:
                self._sync_folder()
        except OSError as error:
            with suppress(OSError):
                scratch.unlink()
            found = error.strerror or str(error)
            expected = "a place that can be written to, with room"
            raise InputFileError(str(self.path), found, expected) from None

    def read(self, parse: Callable[[Path], Value]) -> Value | None:
        """What is in the newest generation that can be read; None: there is none.

        Args:
            parse: Makes the value of a file; raises one of `UNREADABLE` or a `GeoOrbitError` for
                one that is none.

        Raises:
            NewerStateError: As `parse`.
        """
        self.fell_back = False
        generations = (self.path, self.previous) if self.path.exists() else ()
        for file in generations:
            try:
                if file.stat().st_size > MAX_STATE_BYTES:
                    raise ValueError(f"more than {MAX_STATE_BYTES} bytes")
                return parse(file)
            except FileNotFoundError:
                continue
            except NewerStateError:
                raise
            except OSError as error:  # of the disk, not of the content
                found = error.strerror or type(error).__name__
                self.told.append(str(InputFileError(str(file), found, self._kind)))
                self.fell_back = True
            except (*UNREADABLE, GeoOrbitError) as error:
                self._set_aside(file, error)
                self.fell_back = True
        return None

    def _keep_previous(self) -> None:
        """Give the file that is there its second name, before it loses the first."""
        if not self.path.exists():
            return
        scratch = self.path.with_name(f".{self.path.name}.old")
        with suppress(FileNotFoundError):
            scratch.unlink()
        try:
            os.link(self.path, scratch)
        except OSError:  # a file system without such links
            shutil.copyfile(self.path, scratch)
        scratch.replace(self.previous)

    def _set_aside(self, file: Path, error: Exception) -> None:
        damaged = self.path.with_name(f"{self.path.name}.damaged")
        reason = error.found if isinstance(error, GeoOrbitError) else type(error).__name__
        text = str(InputFileError(str(file), f"damage ({reason})", self._kind))
        try:
            file.replace(damaged)
            text += f"; it is {damaged.name} now"
        except OSError as fault:
            text += f"; it stays where it is ({fault.strerror})"
        self.told.append(text)

    def _sync_folder(self) -> None:
        folder = os.open(self.path.absolute().parent, os.O_RDONLY)
        try:
            os.fsync(folder)  # the new name itself: power loss, not kill
        finally:
            os.close(folder)
