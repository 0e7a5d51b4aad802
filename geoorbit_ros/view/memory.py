"""The reference pictures on disk, so that a camera that starts again knows where it looked."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from geoorbit_ros.core.array_file import read_arrays
from geoorbit_ros.core.errors import InputFileError, ParameterError
from geoorbit_ros.view.picture import picture_of, reduction
from geoorbit_ros.view.place import Place
from geoorbit_ros.view.reference import Reference

_NAMES = re.compile(r"\s+(?=\w+=)")
"""Between two of `NAME=FILE`: the names of folders may have blanks."""


def named_files(text: str, place: str) -> dict[str, Path]:
    """Files by the name of their view, of `left=left.png right=right.png`, in that order.

    The k-th of them is view k; view 0 is the camera's own.

    Raises:
        ParameterError: Text that is none of that, or a name twice.
    """
    files: dict[str, Path] = {}
    for word in _NAMES.split(text.strip()) if text.strip() else ():
        name, equals, file = word.partition("=")
        if not (name and equals and file) or name in files:
            raise ParameterError(place, f"'{word}'", "NAME=FILE, each name once")
        files[name] = Path(file)
    return files


def preset_places(files: dict[str, Path]) -> tuple[list[Place], tuple[int, int] | None]:
    """Views of which a picture was given, numbered from 1, and the size of those pictures.

    Raises:
        InputFileError: A picture that can't be read, or of another size than the others.
    """
    places: list[Place] = []
    size: tuple[int, int] | None = None
    for number, file in enumerate(files.values(), 1):
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise InputFileError(str(file), "no image that can be read", "a picture of the view")
        found = (image.shape[1], image.shape[0])
        if size is not None and found != size:
            expected = f"{size[0]}x{size[1]}, as the other views"
            raise InputFileError(str(file), f"{found[0]}x{found[1]} pixels", expected)
        size = found
        picture = picture_of(np.asarray(image, np.uint8), reduction(found[0]))
        places.append(Place(number, [Reference(picture)], settled=True))
    return places, size


FORMAT_VERSION = 1
"""Of saved files; a file of another version is not read."""


def calibration_hash(file: Path | None) -> str:
    """What a reference belongs to: the bytes of the calibration file; empty without one."""
    if file is None:
        return ""
    try:
        return hashlib.sha256(file.read_bytes()).hexdigest()
    except OSError as error:
        raise InputFileError(str(file), error.strerror or str(error), "control points") from None


def save_places(file: Path, places: Sequence[Place], size: tuple[int, int], mark: str) -> None:
    """Replace the file by the views as they are; those that are not settled are left out.

    Args:
        file: Where; its folder is made.
        places: The views.
        size: (width, height) of the images.
        mark: `calibration_hash` of the calibration that they belong to.

    Raises:
        InputFileError: The file can't be written.
    """
    known = [place for place in places if place.settled]
    pictures = [r.picture for place in known for r in place.references]
    if not pictures:
        return
    counts = [(place.number, len(place.references)) for place in known]
    scratch = file.with_name(f".{file.name}.new")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with scratch.open("wb") as stream:
            np.savez_compressed(
                stream,
                about=np.array([f"format {FORMAT_VERSION}", mark, f"{size[0]}x{size[1]}"]),
                views=np.array(counts, np.int64),
                motions=np.stack([place.motion for place in known]),
                pictures=np.stack(pictures),
            )
        scratch.replace(file)
    except OSError as error:
        found = error.strerror or str(error)
        raise InputFileError(str(file), found, "a place that can be written to") from None


def load_places(file: Path, mark: str) -> tuple[list[Place], tuple[int, int]]:
    """Views and image size that were saved; nothing where there is no file.

    Raises:
        InputFileError: A file that is broken, or of another calibration: its pixels say nothing.
    """
    if not file.exists():
        return [], (0, 0)
    try:
        content = read_arrays(file, "saved views")
        version, saved_mark, size = content["about"].tolist()
        views, motions, pictures = (
            content["views"].tolist(),
            content["motions"],
            content["pictures"],
        )
        width, height = (int(side) for side in size.split("x"))
        step = reduction(width)
        wanted = np.array((sum(count for _, count in views), height // step, width // step))
        more = np.array(pictures.shape) - wanted  # decoders may round up
        if more[0] or not np.isin(more, (0, 1)).all() or pictures.dtype != np.uint8:
            raise ValueError(f"pictures of {pictures.shape}, expected {tuple(wanted.tolist())}")
        if motions.shape != (len(views), 3, 3) or not np.isfinite(motions).all():
            raise ValueError(f"motions of {motions.shape}")
    except (
        OSError, ValueError, TypeError, AttributeError, LookupError, OverflowError,
    ) as error:  # fmt: skip
        reason = f"{type(error).__name__}: {error}"
        raise InputFileError(str(file), reason, "saved views") from None
    if version != f"format {FORMAT_VERSION}":
        raise InputFileError(str(file), version, f"format {FORMAT_VERSION}")
    if saved_mark != mark:
        raise InputFileError(str(file), "views of another calibration", "the calibration as it is")
    places, left = [], list(pictures)
    for (number, count), motion in zip(views, motions, strict=True):
        references = [Reference(p) for p in left[:count]]
        del left[:count]
        places.append(Place(number, references, motion, settled=True))
    return places, (width, height)
