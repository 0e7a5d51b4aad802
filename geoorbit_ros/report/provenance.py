"""What a lane map was made from and with, so that anyone can make it again."""

from __future__ import annotations

import hashlib
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

from geoorbit_ros import __version__
from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.report.recording import Recording

_PACKAGES = ("numpy", "scipy", "pyproj")


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
    for name in _PACKAGES[1:]:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:  # a distribution's package without metadata
            found.append(f"{name} of unknown version")
    return ", ".join(found)
