"""A road in perspective with solid vehicles and their shadows, drawn without any of our renderer.

Rougher than a rendered scene and enough to hold a detector to: every box is known.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.scenes.camera import body_corners, look_at

LANES_M = (-5.4, -1.8, 1.8, 5.4)
SPEEDS = (18.0, 22.0, -20.0, -16.0)
SIZES = np.array([[4.5, 1.8, 1.5], [4.8, 1.9, 1.7], [5.6, 2.0, 2.3], [9.0, 2.5, 3.4]])
SHADE = np.array([0.55, 0.48, 0.45])
"""What is left of blue, green and red where the sun does not shine."""
SUN = np.array([0.5, 0.6])
"""Metres that a shadow's tip moves for each metre of height."""
FACES = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (1, 3, 7, 5))
BRIGHTNESS = (0.75, 0.75, 0.6, 0.9, 1.05)


@dataclass(frozen=True)
class Frame:
    stamp_ns: int
    image: NDArray[np.uint8]
    boxes: NDArray[np.float64]
    """(N, 4) left, top, right, bottom of what is visible, cut to the image."""
    visible: NDArray[np.float64]
    """(N,) share of the vehicle that is."""


class MadeRoad:
    """Two lanes each way, straight, seen from a pole beside it."""

    def __init__(
        self,
        size: tuple[int, int] = (960, 540),
        fps: float = 15.0,
        seed: int = 1,
        sun: bool = True,
        noise: float = 1.5,
        spacing_m: float = 45.0,
    ) -> None:
        self.fps, self.sun, self.noise = fps, sun, noise
        self.random = np.random.default_rng(seed)
        self.camera = look_at(
            np.array([-14.0, -20.0, 10.0]), np.array([0.0, 30.0, 0.0]), 60.0, size
        )
        self.empty = self._empty(size)
        self.vehicles = []
        for lane, (x, speed) in enumerate(zip(LANES_M, SPEEDS, strict=True)):
            at = -400.0
            while at < 600.0:
                kind = SIZES[self.random.choice(len(SIZES), p=[0.5, 0.3, 0.1, 0.1])]
                colour = self.random.choice([25, 60, 130, 190, 235]) + self.random.uniform(-15, 15, 3)
                self.vehicles.append((lane, x, at, speed, kind, colour))
                at += self.random.uniform(0.5, 1.6) * spacing_m

    def _empty(self, size: tuple[int, int]) -> NDArray[np.float32]:
        width, height = size
        u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        ray = np.stack([u, v, np.ones_like(u)], axis=2) @ np.linalg.inv(self.camera.matrix[:, :3]).T
        reach = self.camera.centre_m[2] / np.maximum(-ray[..., 2], 1e-6)
        x = self.camera.centre_m[0] + reach * ray[..., 0]
        y = self.camera.centre_m[1] + reach * ray[..., 1]
        road = (np.abs(x) < 7.6) & (ray[..., 2] < 0)
        image = np.where(road[..., None], [98.0, 100.0, 102.0], [50.0, 105.0, 85.0])
        for line in (-7.2, -3.6, -0.1, 0.1, 3.6, 7.2):
            dashed = (np.mod(y, 12.0) < 4.0) | (np.abs(line) != 3.6)
            image[road & (np.abs(x - line) < 0.09) & dashed] = 220.0
        grain = cv2.GaussianBlur(self.random.normal(0, 1, (height, width)), (0, 0), 1.2)
        image *= (1.0 + 0.12 * grain)[..., None]
        image[ray[..., 2] >= -0.01] = (225, 200, 180)
        return cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.7)

    def frame(self, time_s: float) -> Frame:
        size = self.camera.image_size
        xy = np.array([[x, (at + v * time_s + 500) % 1000 - 500] for _, x, at, v, _, _ in self.vehicles])
        heading = np.array([np.pi / 2 if v > 0 else -np.pi / 2 for _, _, _, v, _, _ in self.vehicles])
        sizes = np.array([kind for *_, kind, _ in self.vehicles])
        corners = body_corners(xy, heading, sizes)
        pixel, depth = self.camera.project(corners)
        near = np.flatnonzero(depth.min(axis=1) > 4.0)
        near = near[np.argsort(-depth[near].mean(axis=1))]
        image = self.empty.copy()
        if self.sun:
            shadow = np.zeros(image.shape[:2], np.float32)
            for k in near:
                tip = corners[k].copy()
                tip[:, :2] += tip[:, 2:] * SUN
                tip[:, 2] = 0.0
                self._fill(shadow, self.camera.project(tip)[0], 1.0)
            shadow = cv2.GaussianBlur(shadow, (0, 0), 0.8)[..., None]
            image *= 1.0 + shadow * (SHADE - 1.0).astype(np.float32)
        owner = np.full(image.shape[:2], -1, np.int32)
        whole = {}
        for k in near:
            base = self.vehicles[k][5]
            centre, eye = corners[k].mean(axis=0), self.camera.centre_m
            for face, light in zip(FACES, BRIGHTNESS, strict=True):
                middle = corners[k][list(face)].mean(axis=0)
                if (middle - centre) @ (eye - middle) > 0:
                    shade = np.clip(base * light, 0, 255) if self.sun else np.clip(base, 0, 255)
                    self._fill(image, pixel[k][list(face)], shade.tolist())
            glass = pixel[k][[0, 1, 3, 2]] * 0.5 + pixel[k][[4, 5, 7, 6]] * 0.5
            self._fill(image, 0.35 * glass + 0.65 * pixel[k][[1, 3, 7, 5]], (35, 32, 30))
            self._fill(owner, pixel[k], int(k))
            alone = np.zeros(image.shape[:2], np.uint8)
            self._fill(alone, pixel[k], 1)
            whole[k] = int(np.count_nonzero(alone))
        boxes, visible = [], []
        for k in near:
            rows, columns = np.nonzero(owner == k)
            if len(rows) and whole[k]:
                inside = np.clip(pixel[k], 0, size)
                extent = np.ptp(pixel[k], axis=0).prod()
                cut = np.ptp(inside, axis=0).prod() / max(extent, 1e-9)
                boxes.append([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
                visible.append(len(rows) / whole[k] * cut)
        image += self.random.normal(0, self.noise, image.shape).astype(np.float32)
        picture = np.clip(image, 0, 255).astype(np.uint8)
        return Frame(
            round(time_s * 1e9) + 10**9,
            picture,
            np.array(boxes, float).reshape(-1, 4),
            np.array(visible),
        )

    def frames(self, count: int, start_s: float = 0.0) -> Iterator[Frame]:
        for k in range(count):
            yield self.frame(start_s + k / self.fps)

    @staticmethod
    def _fill(image: NDArray[np.generic], pixel: NDArray[np.float64], value: object) -> None:
        hull = cv2.convexHull(np.round((pixel - 0.5) * 16).astype(np.int32))
        cv2.fillConvexPoly(image, hull, value, cv2.LINE_8, 4)  # type: ignore[call-overload]
