"""A camera's lens as ROS has it: the YAML that `camera_calibration` writes, and `CameraInfo`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import ConfigDict, Field

from geoorbit_ros.calibration.camera_facts import same_view
from geoorbit_ros.calibration.control_point_file import note_odd_lens, read_control_points
from geoorbit_ros.calibration.control_points import ControlPoints
from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.calibration.lens import MODEL, Lens
from geoorbit_ros.core.errors import CalibrationError
from geoorbit_ros.core.input_report import Treatment
from geoorbit_ros.storage.yaml_file import StrictModel, read_text

HALF_PIXEL = 0.5
"""ROS and OpenCV count from the middle of the first pixel, boxes and control points from its
corner."""
SAME_PX = 2.0
"""Two lenses that differ by less anywhere in the image are the same. Chosen: above rounding, and
far below what a zoom changes."""
KIND = "camera_info"
"""What such a file is called, for messages."""
SAME_MATRIX = 1e-3
"""A camera matrix without skew has zeros and a one within this; larger takes rounding for skew."""


class _Numbers(StrictModel):
    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)

    data: list[float]


class _File(StrictModel):
    """The keys that say the lens; others are for other readers."""

    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)

    image_width: int = Field(ge=16, le=32768)
    image_height: int = Field(ge=16, le=32768)
    camera_matrix: _Numbers
    distortion_model: Literal[
        "plumb_bob",
        "rational_polynomial",
        "equidistant",
        "fisheye",
        "thin_prism_fisheye",
        "none",
        "",
    ] = "plumb_bob"
    distortion_coefficients: _Numbers = _Numbers(data=[])


class _Region(StrictModel):
    """`sensor_msgs/RegionOfInterest`: the part of the sensor that the images show."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    x_offset: int = 0
    y_offset: int = 0
    width: int = 0
    height: int = 0


class _Message(StrictModel):
    """`sensor_msgs/CameraInfo` as `ros2 topic echo` prints it."""

    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)

    width: int = Field(ge=16, le=32768)
    height: int = Field(ge=16, le=32768)
    distortion_model: str
    d: list[float]
    k: list[float]
    roi: _Region = _Region()


def read_camera_info(path: str | Path) -> Lens:
    """The lens in a file of `camera_info`: of `camera_calibration`, or a message as it is printed.

    Raises:
        InputFileError: No such file, or none of this kind.
        CalibrationError: A lens that can't be used; see `lens_of`.
    """
    text = read_text(Path(path), KIND)
    if "k" in text.content and "camera_matrix" not in text.content:
        said = text.checked(_Message, text.content)
        size = said.width, said.height
        part = said.roi.x_offset, said.roi.y_offset, said.roi.width, said.roi.height
        whole_images(size, part, str(path))
        return lens_of(size, said.k, said.distortion_model, said.d, str(path))
    found = text.checked(_File, text.content)
    size = found.image_width, found.image_height
    model, coefficients = found.distortion_model, found.distortion_coefficients.data
    return lens_of(size, found.camera_matrix.data, model, coefficients, str(path))


def whole_images(
    image_size: tuple[int, int], region: tuple[int, int, int, int], place: str
) -> None:
    """Refuse the lens of images that show a part of the sensor only: it is that of whole ones.

    Args:
        image_size: (width, height) of the whole images, pixels.
        region: x and y offset, width and height of `sensor_msgs/RegionOfInterest`; zeros: whole.
        place: Where it is from, for errors.

    Raises:
        CalibrationError: The region is a part.
    """
    left, top, width, height = region
    if (left, top) == (0, 0) and (width, height) in ((0, 0), image_size):
        return
    found = f"a region of interest of {width}x{height} px at ({left}, {top})"
    expected = f"the lens of whole images, {image_size[0]}x{image_size[1]}"
    raise CalibrationError(place, found, expected)


def lens_of(
    image_size: tuple[int, int],
    camera_matrix: Sequence[float],
    model: str,
    coefficients: Sequence[float],
    place: str,
) -> Lens:
    """The lens that the numbers of `sensor_msgs/CameraInfo` say, of its raw images.

    Args:
        image_size: (width, height) in pixels.
        camera_matrix: `k`, nine numbers row by row.
        model: `distortion_model`.
        coefficients: `d`.
        place: Where they are from, for errors.

    Raises:
        CalibrationError: Another model than plumb_bob, a camera that isn't calibrated, or numbers
            that no lens has.
    """
    bend = [*coefficients, *([0.0] * max(0, 5 - len(coefficients)))]
    if any(bend[5:]) or (model not in (MODEL, "rational_polynomial", "none", "") and any(bend)):
        named = f"distortion model '{model}' with {len(coefficients)} coefficients"
        raise CalibrationError(place, named, f"'{MODEL}' with k1, k2, p1, p2, k3")
    if len(camera_matrix) != 9 or not camera_matrix[0] > 0.0:
        found = (
            f"a camera matrix of {len(camera_matrix)} numbers, fx = {[*camera_matrix, 0.0][0]:g}"
        )
        raise CalibrationError(place, found, "nine numbers of a calibrated camera")
    fx, skew, cx, zero, fy, cy, *last = camera_matrix
    if max(abs(skew), abs(zero), *np.abs(np.subtract(last, (0.0, 0.0, 1.0)))) > SAME_MATRIX:
        rows = "; ".join(", ".join(f"{n:g}" for n in camera_matrix[k : k + 3]) for k in (0, 3, 6))
        raise CalibrationError(place, f"camera matrix {rows}", "fx, 0, cx; 0, fy, cy; 0, 0, 1")
    k1, k2, p1, p2, k3 = bend[:5]
    middle = cx + HALF_PIXEL, cy + HALF_PIXEL
    try:
        return Lens(fx, fy, *middle, image_size, k1, k2, p1, p2, k3)
    except CalibrationError as error:
        raise CalibrationError(f"{place}, {error.place}", error.found, error.expected) from None


def read_calibration(
    path: str | Path,
    camera_info: str | Path | None = None,
    datum: Datum | None = None,
    *,
    image_size: tuple[int, int] | None = None,
    strict: bool = False,
) -> ControlPoints:
    """Control points with their lens, from their file or from one of `camera_info`.

    Args:
        path: See `read_control_points`, as the others.
        camera_info: YAML file; None or empty: there is none.
        datum: Origin of the map frame.
        image_size: (width, height) of the camera's images in pixels.
        strict: Whether any fault refuses the points.

    Raises:
        InputFileError, CalibrationError: As `read_control_points`, `read_camera_info`,
            `behind_lens`.
    """
    points = read_control_points(path, datum, image_size=image_size, strict=strict)
    if not camera_info:
        return points
    return behind_lens(points, read_camera_info(camera_info), str(camera_info))


def behind_lens(points: ControlPoints, lens: Lens, place: str) -> ControlPoints:
    """Control points with a lens that is known from elsewhere; that of their own file goes first.

    What differs is said in their report.

    Args:
        points: The control points.
        lens: Of the camera's raw images.
        place: Where the lens is from, for people.

    Raises:
        CalibrationError: The lens is of images that are no larger or smaller ones of these.
    """
    size = points.image_size or lens.image_size
    if lens.image_size != size:
        text = f"{place}: the lens of {lens.image_size[0]}x{lens.image_size[1]} images is scaled"
        lens = lens_of_images(lens, size, place)
        points.report.note(Treatment.NOTED, text)
    note_odd_lens(points.report, lens, place)
    own = points.facts.lens
    if own is not None:
        if difference_px(own, lens) > SAME_PX:
            text = f"{place} says another lens than the one that is used, which was known before"
            points.report.note(Treatment.NOTED, text)
        return points
    facts = replace(points.facts, image_size=points.facts.image_size or size, lens=lens)
    return replace(points, facts=facts, image_size=size)


def lens_of_images(lens: Lens, image_size: tuple[int, int], place: str) -> Lens:
    """A lens for images of a size.

    Raises:
        CalibrationError: The images can't show the same view as those that it is of.
    """
    if not same_view(lens.image_size, image_size):
        of, to = (f"{a}x{b}" for a, b in (lens.image_size, image_size))
        raise CalibrationError(place, f"the lens of {of} images", f"that of {to} images")
    return lens if lens.image_size == image_size else lens.scaled(image_size)


def difference_px(one: Lens, other: Lens) -> float:
    """By how much two lenses of one image size bend it differently, and turn its rays, at most."""
    width, height = one.image_size
    u, v = np.meshgrid(np.linspace(0.0, width, 9), np.linspace(0.0, height, 7))
    pixel = np.column_stack((u.ravel(), v.ravel()))
    rays = []
    for lens in (one, other):
        ideal = lens.undistort(pixel)
        rays.append((ideal - [lens.cx, lens.cy]) / [lens.fx, lens.fy] * one.fx)
    with np.errstate(invalid="ignore"):
        off = np.abs(rays[0] - rays[1])
    return float(np.nanmax(off, initial=0.0))
