"""Errors whose message says what was found, what was expected, and where."""

from __future__ import annotations

import errno


class GeoOrbitError(Exception):
    """Root of every error that geoorbit raises on purpose.

    Args:
        place: Where the value came from (`tracks.csv, line 7, column 'w'`, a topic, a parameter).
        found: The offending value, as a person would write it.
        expected: What would have been accepted.
    """

    def __init__(self, place: str, found: object, expected: str) -> None:
        self.place = place
        self.found = found
        self.expected = expected
        super().__init__(f"{place}: found {found}, expected {expected}")

    def __reduce__(self) -> tuple[object, ...]:
        # BaseException would call the class with the message alone; errors travel between workers.
        return _restore, (type(self), str(self), self.__dict__.copy())


def _restore(kind: type[GeoOrbitError], message: str, state: dict[str, object]) -> GeoOrbitError:
    error = kind.__new__(kind, message)
    error.__dict__.update(state)
    return error


class InputFileError(GeoOrbitError):
    """A file that a user gave can't be used."""


DISK_FAULTS = frozenset(
    (
        *(errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM),
        *(errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG, errno.EFBIG),
    )
)
"""What a full disk, a folder that can't be written to, or a name that can't be, are to the system:
the user's to change, wherever they are met."""


def disk_fault(error: OSError) -> InputFileError | None:
    """The same fault as a sentence that names the file; None for any other error."""
    if error.errno not in DISK_FAULTS:
        return None
    place = str(error.filename) if error.filename else "output"
    return InputFileError(place, error.strerror, "a place that can be written to, with room")


class CalibrationError(GeoOrbitError):
    """Control points from which no ground plane can be computed."""


class TableError(GeoOrbitError):
    """An array that is not the table its reader needs."""


class MessageError(GeoOrbitError):
    """A message on a topic that can't be used."""


class ParameterError(GeoOrbitError):
    """A parameter outside its type or bounds."""


class PluginError(GeoOrbitError):
    """A plug-in failed while it ran, or returned something that can't be used."""


class NoTrafficError(GeoOrbitError):
    """Trajectories from which no lane can be seen."""


class RoadNetworkError(GeoOrbitError):
    """A road network, or a map to make one of, that can't be used; or SUMO is not installed."""
