"""Pinhole cameras above a flat road and boxes of vehicles that drive there, with exact truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.control_points import ControlPoints
from geoorbit_ros.core.tables import PIXEL_TRACK_DTYPE

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """At `position_m`, looking `yaw_deg` counter-clockwise from east and `pitch_deg` down."""

    position_m: tuple[float, float, float] = (0.0, 0.0, 12.0)
    yaw_deg: float = 90.0
    pitch_deg: float = 15.0
    focal_px: float = 1400.0
    image_size: tuple[int, int] = (1920, 1080)

    @property
    def rotation(self) -> Array:
        yaw, pitch = np.radians([self.yaw_deg, self.pitch_deg])
        forward = [np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch)]
        right = [np.sin(yaw), -np.cos(yaw), 0.0]
        return np.array([right, np.cross(forward, right), forward])

    @property
    def projection(self) -> Array:
        w, h = self.image_size
        k = np.array([[self.focal_px, 0, w / 2], [0, self.focal_px, h / 2], [0, 0, 1]])
        r = self.rotation
        return np.asarray(k @ np.column_stack((r, -r @ np.array(self.position_m))))

    def project(self, xyz: Array) -> Array:
        uvw = xyz @ self.projection[:, :3].T + self.projection[:, 3]
        return np.asarray(uvw[..., :2] / np.where(uvw[..., 2:] > 0, uvw[..., 2:], np.nan))

    def ground(self, pixel: Array) -> Array:
        matrix = np.linalg.inv(self.projection[:, [0, 1, 3]])
        xyw = np.column_stack((pixel, np.ones(len(pixel)))) @ matrix.T
        return np.asarray(xyw[:, :2] / xyw[:, 2:])

    def control_points(self, columns: int = 5, rows: int = 4) -> ControlPoints:
        """A grid in the image from 10 % below the horizon to the lower border."""
        w, h = self.image_size
        horizon = h / 2 - self.focal_px * np.tan(np.radians(self.pitch_deg))
        top = max(horizon, 0.0) + 0.1 * h
        u, v = np.meshgrid(np.linspace(0.1 * w, 0.9 * w, columns), np.linspace(top, 0.95 * h, rows))
        pixel = np.column_stack((u.ravel(), v.ravel()))
        line = np.arange(2, 2 + len(pixel))
        return ControlPoints(pixel, self.ground(pixel), None, line, "grid.csv")


@dataclass(frozen=True)
class Drive:
    """A vehicle (length, width, height) on a straight line past `through_m` at t = 0."""

    size_m: tuple[float, float, float]
    class_id: int
    through_m: tuple[float, float]
    heading_deg: float
    speed: float = 25.0
    track_id: int = 1

    def centre(self, t: Array) -> Array:
        """Footprint centre (T, 2) at times (T,)."""
        heading = np.radians(self.heading_deg)
        direction = np.array([np.cos(heading), np.sin(heading)])
        return np.asarray(self.through_m + self.speed * t[:, None] * direction)

    def boxes(self, camera: Camera, t: Array) -> Array:
        """Unclipped boxes (T, 4): left, top, right, bottom; NaN when partly behind the camera."""
        heading = np.radians(self.heading_deg)
        turn = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
        length, width, height = self.size_m
        corner = np.array(
            [
                [*(np.array([x * length / 2, y * width / 2]) @ turn), z * height]
                for x in (-1, 1)
                for y in (-1, 1)
                for z in (0, 1)
            ]
        )
        xyz = np.insert(self.centre(t), 2, 0.0, axis=1)[:, None, :] + corner
        uv = camera.project(xyz)
        return np.hstack((uv.min(axis=1), uv.max(axis=1)))


def frames(
    camera: Camera,
    drives: list[Drive],
    t: Array,
    noise_px: float = 1.0,
    seed: int = 0,
) -> list[tuple[int, NDArray[np.void], Array]]:
    """(stamp_ns, rows, true centres (M, 2)) per time; boxes clipped at the image border.

    Vehicles of which less than half the box is in the image are left out.
    """
    random = np.random.default_rng(seed)
    size = np.array([*camera.image_size, *camera.image_size], dtype=np.float64)
    boxes = np.stack([d.boxes(camera, t) for d in drives], axis=1)
    boxes = boxes + noise_px * random.standard_normal(boxes.shape)
    centres = np.stack([d.centre(t) for d in drives], axis=1)
    clipped = np.clip(boxes, 0.0, size)
    side, whole = clipped[..., 2:] - clipped[..., :2], boxes[..., 2:] - boxes[..., :2]
    seen = side.prod(axis=-1) > 0.5 * whole.prod(axis=-1)
    out = []
    for k in range(len(t)):
        rows = np.zeros(int(seen[k].sum()), dtype=PIXEL_TRACK_DTYPE)
        box = clipped[k][seen[k]]
        rows["x"], rows["y"] = (box[:, :2] + box[:, 2:]).T / 2
        rows["width"], rows["height"] = (box[:, 2:] - box[:, :2]).T
        rows["score"] = 0.8
        rows["class_id"] = [d.class_id for d, s in zip(drives, seen[k], strict=True) if s]
        rows["track_id"] = [d.track_id for d, s in zip(drives, seen[k], strict=True) if s]
        out.append((round(t[k] * 1e9), rows, centres[k][seen[k]]))
    return out
