"""Reads tracked boxes from a file of any of the field's formats, recognised by its content."""

from __future__ import annotations

from pathlib import Path

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.input_report import InputReport, Treatment
from geoorbit_ros.core.tables import Frames
from geoorbit_ros.storage.tracks.cleaning import ReadOptions, clean_tracks
from geoorbit_ros.storage.tracks.csv_table import CsvTable
from geoorbit_ros.storage.tracks.json_tracks import JsonBoxes, OtVision
from geoorbit_ros.storage.tracks.kitti import Kitti
from geoorbit_ros.storage.tracks.mot_challenge import MotChallenge
from geoorbit_ros.storage.tracks.raw_tracks import HEAD_BYTES, TrackFormat
from geoorbit_ros.storage.tracks.xml_tracks import Cvat, UaDetrac

FORMATS: tuple[TrackFormat, ...] = (
    OtVision(), Cvat(), UaDetrac(), JsonBoxes(), Kitti(), CsvTable(), MotChallenge(),
)  # fmt: skip
"""In the order in which they are asked: the most distinct first."""
_ALL = ", ".join(known.name for known in FORMATS)


def read_tracks(path: Path, options: ReadOptions | None = None) -> tuple[Frames, InputReport]:
    """Tracked boxes of a file.

    Args:
        path: CSV, MOTChallenge, KITTI, UA-DETRAC, CVAT, OTVision, supervision or Ultralytics.
        options: What the user says about it.

    Returns:
        Frames of `PIXEL_TRACK_DTYPE` in time order, and what was done with the rows.

    Raises:
        InputFileError: Nothing sensible can be made of the file.
        ParameterError: An option that can't be.
    """
    options = options or ReadOptions()
    place, expected = str(path), f"tracked boxes: {_ALL}"
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
    except FileNotFoundError:
        raise InputFileError(place, "no such file", expected) from None
    except OSError as error:
        raise InputFileError(place, error.strerror or str(error), expected) from None
    if not head.strip():
        raise InputFileError(place, "an empty file", expected)
    found = next((known for known in FORMATS if known.recognises(path, head)), None)
    if found is None:
        first = head.split(b"\n", 1)[0][:60].decode("utf-8", errors="replace").strip()
        kind = "binary data" if b"\0" in head else f"a file that begins with {first!r}"
        raise InputFileError(place, kind, expected)
    raw = found.read(path, dict(options.columns))
    if options.columns and not isinstance(found, CsvTable):
        text = f"--columns is not used: {found.name} says itself what its values are"
        raw.report.note(Treatment.NOTED, text)
    if options.fps and raw.stamp_ns is not None:
        raw.report.note(Treatment.NOTED, "--fps is not used: the file has times")
    return clean_tracks(raw, options, found.expected)
