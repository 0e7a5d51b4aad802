"""From a pixel to metres on the road, with the error that goes with it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoorbit_ros.calibration.control_points import ControlPoints
from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.calibration.elementwise import inverse_2x2, total, worst_sigma
from geoorbit_ros.calibration.lens import Lens
from geoorbit_ros.calibration.robust import jacobian, transfer
from geoorbit_ros.core.input_report import Remark

CHUNK = 2048
"""Pixels whose errors are computed together. Chosen: more don't fit into a processor's cache."""


@dataclass(frozen=True, slots=True)
class ControlResidual:
    """How well each control point fits, in the order of the file.

    Attributes:
        pixel_error: (N,) distance in the image between the point and its projected position.
        ground_error_m: (N,) distance on the road between the position and the projected pixel.
        inlier: (N,) whether the point took part in the fit.
    """

    pixel_error: NDArray[np.float64]
    ground_error_m: NDArray[np.float64]
    inlier: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class RoadPlane:
    """Pixels and metres on the road, and the error between them.

    Pixels are those of the camera's real images throughout; `matrix` is behind the lens.

    Attributes:
        matrix: (3, 3) float64, ideal pixel (u, v, 1) to homogeneous local metres; the third
            component, the inverse depth, is positive below the horizon and 1 on average at the
            control points. Without a lens, real pixels are ideal.
        spread: (K, 3, 3) independent 1-sigma changes of `matrix`: the errors that control points
            leave, eight, and those common to all of them. Zeros when the matrix is exact.
        lens: From ideal pixels to real ones; None: the same.
        k1_spread: (K,) how `lens.k1` changes together with each of `spread`; None: not at all.
    """

    matrix: NDArray[np.float64]
    spread: NDArray[np.float64]
    lens: Lens | None = field(default=None, kw_only=True)
    k1_spread: NDArray[np.float64] | None = field(default=None, kw_only=True)

    @property
    def inverse(self) -> NDArray[np.float64]:
        """(3, 3) local metres to homogeneous ideal pixels."""
        return np.asarray(np.linalg.inv(self.matrix), dtype=np.float64)

    def ideal(self, pixel: ArrayLike) -> NDArray[np.float64]:
        """(N, 2) pixels that a pinhole would show in place of real ones; NaN beyond the lens."""
        uv = np.asarray(pixel, dtype=np.float64).reshape(-1, 2)
        return uv if self.lens is None else self.lens.undistort(uv)

    def visible(self, pixel: ArrayLike) -> NDArray[np.bool_]:
        """(N,) whether pixels (N, 2) are below the horizon, so that they show the road."""
        return self._below_horizon(self.ideal(pixel))

    def _below_horizon(self, ideal: NDArray[np.float64]) -> NDArray[np.bool_]:
        return np.asarray(ideal @ self.matrix[2, :2] + self.matrix[2, 2] > 0)

    def to_ground(self, pixel: ArrayLike) -> NDArray[np.float64]:
        """Metres (N, 2) of pixels (N, 2); NaN on and above the horizon."""
        uv = self.ideal(pixel)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self._below_horizon(uv)[:, None], transfer(self.matrix, uv), np.nan)

    def to_pixel(self, local_m: ArrayLike) -> NDArray[np.float64]:
        """Pixels (N, 2) of metres (N, 2); NaN behind the camera, and where no lens shows them."""
        xy = np.asarray(local_m, dtype=np.float64).reshape(-1, 2)
        with np.errstate(divide="ignore", invalid="ignore"):
            uv = transfer(self.inverse, xy)
            uv = np.where(self._below_horizon(uv)[:, None], uv, np.nan)
            return uv if self.lens is None else self.lens.distort(uv)

    def jacobian(self, pixel: ArrayLike) -> NDArray[np.float64]:
        """Metres on the road per pixel, (N, 2, 2), rows (x, y), columns (u, v)."""
        uv = self.ideal(pixel)
        ground = jacobian(self.matrix, uv)
        if self.lens is None:
            return ground
        through = inverse_2x2(self.lens.slope(uv).transpose(1, 2, 0)).transpose(2, 0, 1)
        return np.asarray(ground @ through)

    def fit_covariance(self, pixel: ArrayLike) -> NDArray[np.float64]:
        """Covariance (N, 2, 2) in m^2 that the control points' errors cause at pixels (N, 2).

        This error is the same in every frame: it shifts all vehicles at a place together.
        """
        uv = np.asarray(pixel, dtype=np.float64).reshape(-1, 2)
        covariance = np.empty((len(uv), 2, 2))
        for first in range(0, len(uv), CHUNK):
            shift = self.fit_shifts(uv[first : first + CHUNK]).transpose(1, 2, 0)
            part = total(shift[:, :, None] * shift[:, None])
            covariance[first : first + CHUNK] = part.transpose(2, 0, 1)
        return covariance

    def fit_shifts(self, pixel: ArrayLike) -> NDArray[np.float64]:
        """(N, K, 2) metres by which each independent 1-sigma error of the fit moves pixels (N, 2).

        Two pixels move together: their distance is surer than their places. Each pixel's numbers
        are the same in any company; see `elementwise`.
        """
        ideal = self.ideal(pixel)
        u, v = ideal.T
        m = self.matrix[:, :, None]
        x, y, w = m[:, 0] * u + m[:, 1] * v + m[:, 2]
        c = self.spread[..., None]
        change = c[:, :, 0] * u + c[:, :, 1] * v + c[:, :, 2]
        ground = np.stack((x / w, y / w))
        shifts = (change[:, :2] - ground * change[:, 2:]) / w
        if self.lens is not None and self.k1_spread is not None:
            through = inverse_2x2(self.lens.slope(ideal).transpose(1, 2, 0))
            by_k1 = -total((through * self.lens.slope_of_k1(ideal).T).transpose(1, 0, 2))
            on_road = (m[:2, :2] - ground[:, None] * m[2, :2]) / w
            moved = total((on_road * by_k1).transpose(1, 0, 2))
            shifts += self.k1_spread[:, None, None] * moved
        return np.asarray(shifts.transpose(2, 0, 1))

    def covariance(self, pixel: ArrayLike, sigma_px: ArrayLike) -> NDArray[np.float64]:
        """Covariance (N, 2, 2) in m^2 of the ground position of pixels (N, 2).

        Args:
            pixel: (N, 2).
            sigma_px: 1-sigma of each coordinate, (N,) or one number.
        """
        j = np.ascontiguousarray(self.jacobian(pixel).transpose(2, 1, 0))
        noise = np.asarray(sigma_px, dtype=np.float64) ** 2 * total(j[:, :, None] * j[:, None])
        return np.asarray(noise.transpose(2, 0, 1) + self.fit_covariance(pixel))

    def sigma_m(self, pixel: ArrayLike, sigma_px: ArrayLike) -> NDArray[np.float64]:
        """1-sigma ground error (N,) along its worst direction; infinite above the horizon."""
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            worst = worst_sigma(self.covariance(pixel, sigma_px).transpose(1, 2, 0))
        return np.where(self.visible(pixel), worst, np.inf)


@dataclass(frozen=True, slots=True)
class Homography(RoadPlane):
    """The road plane as one camera sees it, with the control points that say so.

    Attributes:
        points: The control points behind it.
        residual: Error at each of them.
        remarks: What is to be said about the fit.
    """

    points: ControlPoints
    residual: ControlResidual
    remarks: tuple[Remark, ...] = ()

    @property
    def datum(self) -> Datum | None:
        """Origin of the map frame, None when the control points were given in metres."""
        return self.points.datum

    def residual_texts(self) -> dict[str, str]:
        """By `control_point_line_<line>`, the error at each control point, for tables."""
        r = self.residual
        return {
            f"control_point_line_{self.points.line_number[k]}": f"{r.pixel_error[k]:.2f} px, "
            f"{r.ground_error_m[k]:.3f} m{'' if r.inlier[k] else ', rejected'}"
            for k in range(len(self.points))
        }

    def describe_residuals(self) -> list[str]:
        """One sentence per control point: where it is, its error, whether it was used."""
        lines = []
        for k in range(len(self.points)):
            used = "used" if self.residual.inlier[k] else "REJECTED, disagrees with the others"
            lines.append(
                f"{self.points.place}, line {self.points.line_number[k]}: "
                f"{self.residual.pixel_error[k]:.1f} px, "
                f"{self.residual.ground_error_m[k]:.2f} m, {used}"
            )
        return lines
