"""Collects the vehicles' paths for the report, and the files, parameters and versions used."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros import __version__
from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.tables import FLAG_TRUNCATED, Frames, frames_between

MIN_STEP_M = 2.0
"""Between points of a drawn path. Chosen: nearer points don't change its shape, but make the page
larger."""
MAX_GAP_S = 1.0
"""A longer pause starts a new path. Chosen: the tracker may have used the id again; smaller cuts
paths at short gaps."""
MAX_JUMP_M = 15.0
"""A longer step between two frames starts a new path, because the id jumped to another vehicle.
Chosen: larger draws jumps, smaller cuts paths of fast vehicles where frames are missing."""
MIN_PATH_M = 8.0
"""Shorter paths are not drawn. Chosen: two car lengths; shorter ones are mostly noise of standing
vehicles."""


@dataclass(slots=True)
class Recording:
    """Keeps ground tracks for drawing while they are passed on to the mapper."""

    frame_count: int = 0
    first_ns: int = 0
    last_ns: int = 0
    _blocks: list[Frames] = field(default_factory=list)

    def tee(self, tracks: Iterable[Frames]) -> Iterator[Frames]:
        """Yield blocks of frames of `TRACK_DTYPE` rows unchanged, keeping them."""
        for block in tracks:
            if len(block):
                self.first_ns = self.first_ns if self.frame_count else int(block.stamp_ns[0])
                self.last_ns = int(block.stamp_ns[-1])
            self.frame_count += len(block)
            self._blocks.append(block)
            yield block

    def frames(self, first_ns: int | None = None, last_ns: int | None = None) -> Frames:
        """The ground tracks, those from one stamp to another (both included) if they are given."""
        return frames_between(self._blocks, first_ns, last_ns)

    @property
    def duration_s(self) -> float:
        """Data time between the first and the last frame."""
        return (self.last_ns - self.first_ns) / 1e9

    @property
    def row_count(self) -> int:
        """Positions on the ground, of all vehicles and frames."""
        return sum(len(block.rows) for block in self._blocks)

    @property
    def track_count(self) -> int:
        """Distinct track ids."""
        return len({k for block in self._blocks for k in block.rows["track_id"].tolist()})

    def paths(self) -> list[NDArray[np.float64]]:
        """(K, 2) metres, K >= 2, one per uninterrupted drive, in the order of track ids.

        Positions of boxes cut off by the image border are left out: they bend away from the lane.
        """
        if not self._blocks:
            return []
        rows = np.concatenate([block.rows for block in self._blocks])
        stamp = np.concatenate([block.row_stamp_ns() for block in self._blocks])
        whole = (rows["flags"] & FLAG_TRUNCATED) == 0
        rows, stamp = rows[whole], stamp[whole]
        order = np.lexsort((stamp, rows["track_id"]))
        track_id, stamp = rows["track_id"][order], stamp[order]
        xy = np.column_stack((rows["x"], rows["y"])).astype(np.float64)[order]
        step = np.hypot(*np.diff(xy, axis=0).T)
        new = (np.diff(track_id) != 0) | (np.diff(stamp) > MAX_GAP_S * 1e9) | (step > MAX_JUMP_M)
        paths = (_thinned(part) for part in np.split(xy, np.flatnonzero(new) + 1))
        return [p for p in paths if len(p) > 1 and np.hypot(*(p[-1] - p[0])) >= MIN_PATH_M]


def _thinned(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    if len(xy) < 2:
        return xy
    arc = np.append(0.0, np.cumsum(np.hypot(*np.diff(xy, axis=0).T)))
    _, keep = np.unique(np.floor(arc / MIN_STEP_M), return_index=True)
    return np.vstack((xy[keep], xy[-1:]))


_PACKAGES = ("scipy", "pyproj")


def provenance(
    *,
    source: Path,
    calibration: Path,
    recording: Recording,
    datum: Datum,
    image_size: tuple[int, int],
    method: str,
) -> list[tuple[str, str]]:
    """Names and values for the page: files with their SHA-256, parameters, versions."""
    return [
        ("Tracks", f"{source.name}, {recording.row_count:,} positions"),
        ("Tracks SHA-256", sha256(source)),
        ("Control points", calibration.name),
        ("Control points SHA-256", sha256(calibration)),
        ("Data time", f"{recording.first_ns / 1e9:.3f} to {recording.last_ns / 1e9:.3f} s"),
        ("Image", f"{image_size[0]} × {image_size[1]} px"),
        ("Datum", f"{datum.latitude_deg:.8f}, {datum.longitude_deg:.8f}"),
        ("Projection", datum.proj_string),
        ("Method", method),
        ("geoorbit", __version__),
        ("Python", f"{platform.python_version()}, numpy {np.__version__}, {_versions()}"),
    ]


def sha256(path: Path) -> str:
    """Hash of a file, or of a folder's files in the order of their names."""
    digest = hashlib.sha256()
    for file in sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]:
        with file.open("rb") as stream:
            while chunk := stream.read(1 << 20):
                digest.update(chunk)
    return digest.hexdigest()


def _versions() -> str:
    found = []
    for name in _PACKAGES:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:  # a distribution's package without metadata
            found.append(f"{name} of unknown version")
    return ", ".join(found)
