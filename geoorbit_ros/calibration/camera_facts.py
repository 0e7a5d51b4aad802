"""What a calibration file says about its camera above the header.

Comment lines, each once and in any order, in the manner of `# CRS: EPSG:25832`:

    # image_size: 1920x1080
    # lens: plumb_bob fx fy cx cy k1 k2 p1 p2 k3
    # scale_sigma: 0.03
    # north: unknown
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from geoorbit_ros.calibration.lens import MODEL, Lens
from geoorbit_ros.core.errors import CalibrationError

_FACT = re.compile(
    r"#\s*(image[_ -]?size|lens|scale[_ -]?sigma|north)"
    rf"(?:\s*[:=]\s*|\s+(?={MODEL}\b|[\d.]))(.*?)\s*",
    re.IGNORECASE,
)
"""Without the colon only where a number or the model follows: other comments are for people."""
_SIZE = re.compile(r"(\d{2,5})\s*[x×*]\s*(\d{2,5})(?:\s*(?:px|pixels?))?", re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+(?:e[+-]?\d+)?", re.IGNORECASE)
UNKNOWN = "unknown"
"""What the line `# north:` may say; a file without it has true north."""
MAX_SCALE_SIGMA = 0.5
"""A scale less certain than this is none."""
SAME_ASPECT = 0.005
"""Sizes whose ratios of width and height differ by less show the same view. Chosen: 1280x720 and
854x480 differ by 0.001, 16:9 and 16:10 by 0.1; larger takes a cut image for a smaller one."""
SIZE_PX = (16, 32768)
"""Least and largest side of an image."""

MIDDLE = "the principal point near the middle of the image, or a line '# image_size:'"


@dataclass(frozen=True, slots=True)
class CameraFacts:
    """What is known of a camera beside its control points.

    Attributes:
        image_size: (width, height) of the image that the pixels belong to; None: nobody says.
        lens: Its distortion; None: none, or not known.
        scale_sigma: Relative 1-sigma error of all distances between the points, common to them.
        north_known: Whether y of the points is true north; else it is any direction.
    """

    image_size: tuple[int, int] | None = None
    lens: Lens | None = None
    scale_sigma: float = 0.0
    north_known: bool = True

    def lines(self) -> list[str]:
        """The comment lines that say so."""
        found = []
        if self.image_size is not None:
            found.append(f"# image_size: {self.image_size[0]}x{self.image_size[1]}")
        if self.lens is not None:
            found.append(f"# lens: {MODEL} " + " ".join(f"{n:.9g}" for n in self.lens.numbers))
        if self.scale_sigma > 0.0:
            found.append(f"# scale_sigma: {self.scale_sigma:.4g}")
        if not self.north_known:
            found.append(f"# north: {UNKNOWN}")
        return found

    def scaled(self, image_size: tuple[int, int]) -> CameraFacts:
        """The same for images of another size of the same view."""
        lens = None if self.lens is None else self.lens.scaled(image_size)
        return replace(self, image_size=image_size, lens=lens)


NO_FACTS = CameraFacts()
"""Nothing is said."""


def read_facts(
    comments: Sequence[str], place: str, image_size: tuple[int, int] | None = None
) -> CameraFacts:
    """The facts in comment lines; other comments are for people.

    Args:
        comments: Lines that begin with `#`.
        place: For errors.
        image_size: (width, height) that a lens without `image_size` line belongs to.

    Raises:
        CalibrationError: A line of these names that can't be read, or two that differ.
    """
    said: dict[str, str] = {}
    for line in comments:
        if (found := _FACT.fullmatch(line)) is None:
            continue
        name = re.sub("[ -]|(?<=e)(?=size$|sigma$)", "_", found[1].lower()).replace("__", "_")
        before = said.setdefault(name, found[2])
        if before.split() != found[2].split():
            named = f"'{before[:60]}' and '{found[2][:60]}'"
            raise CalibrationError(f"{place}, '# {name}:'", named, "one of them")
    size = _size(said["image_size"], place) if "image_size" in said else None
    lens = _lens(said["lens"], place, size or image_size) if "lens" in said else None
    sigma = _scale_sigma(said["scale_sigma"], place) if "scale_sigma" in said else 0.0
    if (north := said.get("north", UNKNOWN)).lower() != UNKNOWN:
        expected = f"'{UNKNOWN}', or no such line"
        raise CalibrationError(f"{place}, '# north:'", f"'{north[:40]}'", expected)
    return CameraFacts(size, lens, sigma, "north" not in said)


def same_view(one: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether images of these sizes may be one view, scaled."""
    ratio = one[0] * other[1] / (one[1] * other[0])
    return abs(ratio - 1.0) <= SAME_ASPECT


def _size(text: str, place: str) -> tuple[int, int]:
    found = _SIZE.fullmatch(text)
    size = (int(found[1]), int(found[2])) if found else (0, 0)
    if not all(SIZE_PX[0] <= side <= SIZE_PX[1] for side in size):
        expected = "WIDTHxHEIGHT such as 1920x1080"
        raise CalibrationError(f"{place}, '# image_size:'", f"'{text[:40]}'", expected)
    return size


def _lens(text: str, place: str, size: tuple[int, int] | None) -> Lens:
    expected = f"'{MODEL} fx fy cx cy k1 k2 p1 p2 k3'"
    place = f"{place}, '# lens:'"
    model, *words = text.split() or [""]
    if len(words) >= 4 and any(_DECIMAL_COMMA.fullmatch(word) for word in words):
        words = [word.rstrip(",;").replace(",", ".") for word in words]
    else:
        model, *words = re.split(r"[\s,;]+", text.strip())
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if model.lower() != MODEL or not 4 <= len(numbers) <= 9 or not np.isfinite(numbers).all():
        raise CalibrationError(place, f"'{text[:80]}'", expected)
    if size is None and not min(numbers[2:4]) > 0.0:
        raise CalibrationError(
            place, f"a lens with cx, cy = {numbers[2]:g}, {numbers[3]:g}", MIDDLE
        )
    if size is None:  # the principal point is near the middle, and that is all it is asked for
        size = (round(2 * numbers[2]), round(2 * numbers[3]))
    try:
        fx, fy, cx, cy, *coefficients = numbers
        k1, k2, p1, p2, k3 = coefficients + [0.0] * (5 - len(coefficients))
        return Lens(fx, fy, cx, cy, size, k1, k2, p1, p2, k3)
    except CalibrationError as error:
        raise CalibrationError(f"{place}, {error.place}", error.found, error.expected) from None


def _scale_sigma(text: str, place: str) -> float:
    text = re.sub(r"(?<=\d),(?=\d)", ".", text)
    try:
        sigma = float(text.rstrip("% ")) / (100.0 if text.endswith("%") else 1.0)
    except ValueError:
        sigma = float("nan")
    if not 0.0 <= sigma <= MAX_SCALE_SIGMA:
        expected = f"a share such as 0.03, at most {MAX_SCALE_SIGMA:g}"
        raise CalibrationError(f"{place}, '# scale_sigma:'", f"'{text[:40]}'", expected)
    return sigma
