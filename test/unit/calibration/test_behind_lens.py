"""Behind a lens, boxes, paint and images give what they give without one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from cameras import Camera, Drive, frames
from numpy.typing import NDArray

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.camera_facts import CameraFacts
from geoorbit_ros.calibration.control_points import ControlPoints
from geoorbit_ros.calibration.homography import Homography, fit_homography
from geoorbit_ros.calibration.lens import Lens
from geoorbit_ros.core.tables import FLAG_GROUND_POINT, join_frames
from geoorbit_ros.markings.road_image import rectify

Array = NDArray[np.float64]

SIZE = (1920, 1080)
LENS = Lens(1500.0, 1500.0, 960.0, 540.0, SIZE, -0.26, 0.03, 1e-3, -1e-3)
CAR, LORRY = (4.6, 1.85, 1.5), (9.0, 2.5, 3.5)
TIMES = np.arange(0, 12, 0.1)


@dataclass(frozen=True)
class BentCamera(Camera):
    """The same camera with a lens: its boxes are round the corners as the lens shows them."""

    def project(self, xyz: Array) -> Array:
        return LENS.distort(super().project(xyz))

    def control_points(self, columns: int = 5, rows: int = 4) -> ControlPoints:
        ideal = super().control_points(columns, rows)
        facts = CameraFacts(SIZE, LENS)
        return replace(ideal, pixel=LENS.distort(ideal.pixel), facts=facts, image_size=SIZE)


PLACE = ((0.0, 0.0, 10.0), 70.0, 16.0, 1500.0)
PINHOLE, BENT = Camera(*PLACE), BentCamera(*PLACE)


def drives(size_m: tuple[float, float, float], class_id: int) -> list[Drive]:
    ways = [(x, heading) for x in (-9.0, -3.0, 3.0, 9.0, 15.0) for heading in (90, 270)]
    return [
        Drive(size_m, class_id, (x, 40 - 150.0 * (1 if heading == 90 else -1)), heading, 25.0, k)
        for k, (x, heading) in enumerate(ways)
    ]


def errors_m(camera: Camera, size_m: tuple[float, float, float], class_id: int) -> Array:
    """Distances of ground points from the vehicles, where they are said to be good to a metre."""
    projector = BoxProjector(fit_homography(camera.control_points()), SIZE)
    found = []
    for stamp_ns, rows, centres in frames(camera, drives(size_m, class_id), TIMES):
        ground = projector.project(stamp_ns, rows)
        pick = [rows["track_id"].tolist().index(k) for k in ground["track_id"]]
        off = np.column_stack((ground["x"], ground["y"])) - centres[pick]
        found.append(np.hypot(*off[ground["sigma"] < 1.0].T))
    return np.concatenate(found)


@pytest.mark.parametrize(("size_m", "class_id"), [(CAR, 2), (LORRY, 7)])
def test_ground_points_are_as_good_as_without_a_lens(
    size_m: tuple[float, float, float], class_id: int
) -> None:
    plain, bent = (errors_m(camera, size_m, class_id) for camera in (PINHOLE, BENT))
    assert len(bent) > 100
    assert np.median(bent) < np.median(plain) + 0.02
    assert np.quantile(bent, 0.95) < np.quantile(plain, 0.95) + 0.1


def test_without_a_pose_the_foot_of_the_box_goes_through_the_lens_too() -> None:
    high = BentCamera((0.0, 0.0, 60.0), 90.0, 89.99, 1500.0)
    projector = BoxProjector(fit_homography(high.control_points()), SIZE)
    rows = frames(high, drives(CAR, 2), TIMES)[60][1].copy()
    rows["flags"] |= FLAG_GROUND_POINT
    ground = projector.project(1, rows)
    pixel = np.column_stack((rows["x"], rows["y"])).astype(float)
    expected = projector.homography.to_ground(pixel)
    kept = [rows["track_id"].tolist().index(k) for k in ground["track_id"]]
    got = np.column_stack((ground["x"], ground["y"]))
    np.testing.assert_allclose(got, expected[kept], atol=1e-3)


@pytest.mark.parametrize("at_once", [1, 7, 40])
def test_blocks_give_the_bytes_of_single_frames(at_once: int) -> None:
    plane = fit_homography(BENT.control_points())
    every = [(stamp, rows) for stamp, rows, _ in frames(BENT, drives(LORRY, 7), TIMES)]
    one, many = BoxProjector(plane, SIZE), BoxProjector(plane, SIZE)
    single = b"".join(one.project(stamp, rows).tobytes() for stamp, rows in every)
    parts = [every[k : k + at_once] for k in range(0, len(every), at_once)]
    block = b"".join(many.project_block(join_frames(part)).rows.tobytes() for part in parts)
    assert single == block
    assert len(single) > 10_000


def test_a_strip_of_road_is_sampled_through_the_lens() -> None:
    plane: Homography = fit_homography(BENT.control_points())
    line = np.column_stack((np.full(40, 2.0), np.linspace(15.0, 60.0, 40)))
    # An image that says in its colours which place on the road each pixel shows.
    u, v = np.meshgrid(np.arange(1920) + 0.5, np.arange(1080) + 0.5)
    x = plane.to_ground(np.column_stack((u.ravel(), v.ravel())))[:, 0].reshape(1080, 1920)
    image = np.repeat(np.clip(np.nan_to_num(20.0 * (x + 4.0)), 0, 255)[..., None], 3, 2)
    strip = rectify(image.astype(np.uint8), plane, line, -3.0, 3.0)
    east = strip.point_m[:, None, 0] + strip.offset_m[None] * strip.normal[:, None, 0]
    shown = strip.bgr[..., 0] / 20.0 - 4.0
    assert strip.seen.mean() > 0.9
    assert np.abs(shown - east)[strip.seen].max() < 0.11  # steps of 0.05 m, and between pixels

    step, (k, d) = 1e-3, np.argwhere(strip.seen)[len(np.argwhere(strip.seen)) // 2]
    place = strip.point_m[k] + strip.offset_m[d] * strip.normal[k]
    for direction, size_m in (((1.0, 0.0), strip.across_m), ((0.0, 1.0), strip.along_m)):
        ends = plane.to_pixel([place + step * np.array(direction), place])
        assert size_m[k, d] == pytest.approx(step / np.hypot(*(ends[0] - ends[1])), rel=1e-3)
