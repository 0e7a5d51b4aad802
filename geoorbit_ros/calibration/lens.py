"""What a lens does to pixels: from the image that a pinhole would show to the real one, and back.

The model is `plumb_bob`, as ROS (sensor_msgs/CameraInfo) and OpenCV have it: three radial and two
tangential coefficients (Brown (1966), Decentering Distortion of Lenses). Real and ideal pixels have
the same camera matrix: where the lens does nothing, they are equal.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoorbit_ros.core.errors import CalibrationError

Array = NDArray[np.float64]

MODEL = "plumb_bob"
ITERATIONS = 20
"""Steps of Newton's method at most. In a model without a fold they double the right digits each
time, at the fold they halve the error: the fold itself is found to 1e-6 of the focal length."""
EXACT = 1e-9
"""Steps below this share of the focal length end the search: a millionth of a pixel. Chosen: larger
is seen in differences of positions, smaller takes a step more."""
FOUND = 1e-4
"""A pixel whose ideal one is not found to this share of the focal length, a tenth of a pixel, lies
beyond the model. Chosen: larger takes pixels for seen that no ray reaches, smaller loses those at
the fold."""
COEFFICIENTS = {"k1": 2.0, "k2": 10.0, "p1": 0.2, "p2": 0.2, "k3": 50.0}
"""Largest absolute value of each coefficient. Chosen: several times what lenses of cameras have
(k1 -0.5 to 0.3); beyond, numbers were exchanged."""
FOCAL_WIDTHS = (0.1, 50.0)
"""Focal length over image width that a lens may have. Chosen: 160 degrees to 1 degree."""


@dataclass(frozen=True, slots=True)
class Lens:
    """Camera matrix and distortion of one camera at one zoom.

    Attributes:
        fx: Focal length in pixels along the image's rows.
        fy: The same along its columns.
        cx: Principal point in pixels, in the coordinates of the control points and boxes.
        cy: The same downwards.
        image_size: (width, height) of the images they belong to, in pixels.
        k1: First radial coefficient: negative for a barrel, positive for a pincushion.
        k2: Second radial coefficient.
        p1: First tangential coefficient.
        p2: Second tangential coefficient.
        k3: Third radial coefficient.
        focal_known: The focal lengths are those of the camera; False where they are a unit
            only, and say nothing about heights.

    Raises:
        CalibrationError: A number that no lens has.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    image_size: tuple[int, int]
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    focal_known: bool = True

    def __post_init__(self) -> None:
        width, height = self.image_size
        for name, value in (("fx", self.fx), ("fy", self.fy)):
            low, high = (factor * width for factor in FOCAL_WIDTHS)
            if not low <= value <= high:
                expected = f"{low:.0f} to {high:.0f} px for an image of {width}x{height}"
                raise CalibrationError(f"lens, {name}", f"{value:g} px", expected)
        for name, value, side in (("cx", self.cx, width), ("cy", self.cy, height)):
            if not 0.0 <= value <= side:
                expected = f"0 to {side}: a pixel of a {width}x{height} image"
                raise CalibrationError(f"lens, {name}", f"{value:g} px", expected)
        for name, bound in COEFFICIENTS.items():
            if not abs(value := getattr(self, name)) <= bound:
                raise CalibrationError(f"lens, {name}", value, f"{-bound:g} to {bound:g}")

    @property
    def numbers(self) -> tuple[float, ...]:
        """fx, fy, cx, cy, k1, k2, p1, p2, k3."""
        matrix = (self.fx, self.fy, self.cx, self.cy)
        return (*matrix, self.k1, self.k2, self.p1, self.p2, self.k3)

    @property
    def straight(self) -> bool:
        """Whether there is no distortion, only a camera matrix."""
        return not any(self.numbers[4:])

    @property
    def camera_matrix(self) -> Array:
        """(3, 3) from rays in the optical frame to homogeneous pixels."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    @property
    def radius(self) -> float:
        """Largest distance from the axis, over the focal length, at which the model is good.

        Beyond, a ray farther from the axis would show nearer to it: the model folds over.
        """
        return _fold(self.k1, self.k2, self.k3)

    def scaled(self, image_size: tuple[int, int]) -> Lens:
        """The same lens for images of another size of the same view."""
        right, down = (a / b for a, b in zip(image_size, self.image_size, strict=True))
        return replace(
            self, fx=self.fx * right, cx=self.cx * right, fy=self.fy * down, cy=self.cy * down,
            image_size=image_size,
        )  # fmt: skip

    def distort(self, pixel: ArrayLike) -> Array:
        """Real pixels (..., 2) of ideal ones (..., 2); NaN beyond `radius`."""
        if self.straight:
            return np.array(pixel, dtype=np.float64)
        x, y = self._rays(np.asarray(pixel, dtype=np.float64))
        shown = np.stack(self._bent(x, y), axis=-1)
        shown[~(x * x + y * y <= self.radius**2)] = np.nan
        return self._pixels(shown)

    def undistort(self, pixel: ArrayLike) -> Array:
        """Ideal pixels (..., 2) of real ones (..., 2); NaN where no ray leads there.

        Newton's method; each pixel's result is the same in any company (`elementwise`).
        """
        if self.straight:
            return np.array(pixel, dtype=np.float64)
        u, v = self._rays(np.asarray(pixel, dtype=np.float64))
        with np.errstate(all="ignore"):
            x, y = u, v
            last = np.full(x.shape, np.inf)
            for _ in range(ITERATIONS):
                (a, b), (c, d) = self._slope(x, y)
                seen_x, seen_y = self._bent(x, y)
                off_x, off_y = u - seen_x, v - seen_y
                determinant = a * d - b * c
                step_x = (d * off_x - b * off_y) / determinant
                step_y = (a * off_y - c * off_x) / determinant
                going = last > EXACT
                x, y = np.where(going, x + step_x, x), np.where(going, y + step_y, y)
                last = np.where(going, np.abs(step_x) + np.abs(step_y), last)
                if not (last > EXACT).any():
                    break
            seen_x, seen_y = self._bent(x, y)
            missed = np.abs(u - seen_x) + np.abs(v - seen_y)
            good = (missed <= FOUND) & (x * x + y * y <= self.radius**2 + FOUND)
        found = np.stack((x, y), axis=-1)
        found[~good] = np.nan
        return self._pixels(found)

    def slope(self, pixel: ArrayLike) -> Array:
        """d(real) / d(ideal) at ideal pixels (..., 2): (..., 2, 2), rows real u and v."""
        (a, b), (c, d) = self._slope(*self._rays(np.asarray(pixel, dtype=np.float64)))
        ratio = self.fx / self.fy
        rows = np.stack((a, b * ratio), axis=-1), np.stack((c / ratio, d), axis=-1)
        return np.stack(rows, axis=-2)

    def distort_columns(self, pixel: Array) -> tuple[Array, Array]:
        """`distort` and `slope` of (2, ...) ideal pixels, components first: (2, ...), (2, 2, ...).

        As the many-vehicles code has them (`elementwise`).
        """
        rows = np.moveaxis(pixel, 0, -1)
        slope = np.moveaxis(self.slope(rows), (-2, -1), (0, 1))
        return np.moveaxis(self.distort(rows), -1, 0), slope

    def undistort_columns(self, pixel: Array) -> Array:
        """`undistort` of (2, ...) real pixels, components first."""
        return np.moveaxis(self.undistort(np.moveaxis(pixel, 0, -1)), -1, 0)

    def slope_of_k1(self, pixel: ArrayLike) -> Array:
        """d(real) / d(k1) at ideal pixels (..., 2): (..., 2)."""
        x, y = self._rays(np.asarray(pixel, dtype=np.float64))
        square = x * x + y * y
        return np.stack((self.fx * x * square, self.fy * y * square), axis=-1)

    def _rays(self, pixel: Array) -> tuple[Array, Array]:
        return (pixel[..., 0] - self.cx) / self.fx, (pixel[..., 1] - self.cy) / self.fy

    def _pixels(self, ray: Array) -> Array:
        ray[..., 0] = ray[..., 0] * self.fx + self.cx
        ray[..., 1] = ray[..., 1] * self.fy + self.cy
        return ray

    def _bent(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Where rays show, in units of the focal length."""
        square, twice = x * x + y * y, 2.0 * x * y
        gain = 1.0 + square * (self.k1 + square * (self.k2 + square * self.k3))
        right = x * gain + self.p1 * twice + self.p2 * (square + 2.0 * x * x)
        down = y * gain + self.p2 * twice + self.p1 * (square + 2.0 * y * y)
        return right, down

    def _slope(self, x: Array, y: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """Of `_bent`: rows of d(right, down) / d(x, y)."""
        square = x * x + y * y
        gain = 1.0 + square * (self.k1 + square * (self.k2 + square * self.k3))
        more = 2.0 * (self.k1 + square * (2.0 * self.k2 + square * 3.0 * self.k3))
        across = x * y * more + 2.0 * (self.p1 * x + self.p2 * y)
        right = gain + x * x * more + 2.0 * self.p1 * y + 6.0 * self.p2 * x
        down = gain + y * y * more + 2.0 * self.p2 * x + 6.0 * self.p1 * y
        return (right, across), (across, down)


@dataclass(frozen=True, slots=True)
class LensEstimate:
    """What was found about a lens.

    Attributes:
        lens: The lens; None where no distortion shows, or nothing can be told.
        k1: Its first coefficient, in units of the focal length of `lens`, or of the image's width
            where there is none; NaN where nothing can be told.
        k1_sigma: Its 1-sigma error, in the same units; infinite where nothing can be told.
        sentence: What was found, for people.
    """

    lens: Lens | None
    k1: float
    k1_sigma: float
    sentence: str


def unit_lens(image_size: tuple[int, int], k1: float) -> Lens:
    """A lens whose unit is the image's width, with its axis in the image's middle.

    Through one plane or from straight lines, only k1 over the square of the focal length shows.
    """
    width, height = image_size
    axis = width / 2, height / 2
    return Lens(float(width), float(width), *axis, image_size, k1, focal_known=False)


def with_focal(lens: Lens, focal_px: float) -> Lens:
    """The same distortion by k1 in units of another focal length."""
    gain = (focal_px / lens.fx) ** 2
    return replace(lens, fx=focal_px, fy=lens.fy * focal_px / lens.fx, k1=lens.k1 * gain)


@lru_cache(maxsize=64)
def _fold(k1: float, k2: float, k3: float) -> float:
    """Least radius at which 1 + 3 k1 r^2 + 5 k2 r^4 + 7 k3 r^6 is zero, else infinity."""
    roots = np.roots([7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])
    real = roots[np.abs(roots.imag) < 1e-12].real
    return float(np.sqrt(real[real > 0.0].min(initial=np.inf)))
