"""A crest shows in vehicles' sizes, at its place and of its height; a flat road shows none."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.flatness import Stretch, road_stretches
from geoorbit_ros.calibration.homography import Homography, fit_homography
from geoorbit_ros.calibration.vehicle_fit import CORNER
from geoorbit_ros.core.tables import PIXEL_TRACK_DTYPE, Frames
from geoorbit_ros.scenes.scene import load_scene
from geoorbit_ros.scenes.simulate import simulate

Array = NDArray[np.float64]
SIZE = (1920, 1080)
CAR = np.array([4.7, 1.85, 1.6])


@pytest.fixture(scope="module")
def plane() -> Homography:
    """The camera of a simulated scene."""
    return fit_homography(simulate(load_scene("straight_3x3"), 1.0, 1).control_points)


def drive(plane: Homography, height_m: Callable[[Array], Array], grow_px: float = 0.0) -> Frames:
    """Thirty cars that drive away from the camera, each seen as a box, on a road of some height.

    Args:
        plane: The calibration.
        height_m: The road's height above it by the distance from the camera.
        grow_px: By how much the detector draws boxes too large.
    """
    rng = np.random.default_rng(2)
    pose = BoxProjector(plane, SIZE).pose
    assert pose is not None
    ends = plane.to_ground([[960.0, 1000.0], [960.0, 420.0]])
    ahead = (ends[1] - ends[0]) / np.hypot(*(ends[1] - ends[0]))
    aside = np.array([-ahead[1], ahead[0]])
    rows, stamps = [], []
    for car in range(30):
        size = CAR * rng.normal(1.0, 0.06)
        for step in range(50):
            middle = ends[0] + ahead * (2.2 * step) + aside * (3.5 * (car % 3) - 3.5)
            distance = np.hypot(*(middle - pose.position_m[:2]))
            corner = (size[:, None] * CORNER).T
            level = np.full(8, float(height_m(np.array(distance))))
            xyz = np.column_stack(
                [middle + corner[:, :1] * ahead + corner[:, 1:2] * aside, corner[:, 2] + level]
            )
            uv = pose.project(xyz)
            low, high = uv.min(axis=0) - grow_px, uv.max(axis=0) + grow_px
            if (low < 5.0).any() or (high > np.array(SIZE) - 5.0).any():
                continue
            row = np.zeros(1, PIXEL_TRACK_DTYPE)
            edges = np.concatenate([low, high]) + rng.normal(0.0, 0.7, 4)
            row["x"], row["y"] = (edges[0] + edges[2]) / 2, (edges[1] + edges[3]) / 2
            row["width"], row["height"] = edges[2] - edges[0], edges[3] - edges[1]
            row["class_id"], row["score"], row["track_id"] = 2, 0.9, car + 1
            rows.append(row)
            stamps.append(10**9 * (8 * car) + 10**8 * step)
    return Frames(np.array(stamps), np.arange(len(rows) + 1), np.concatenate(rows))


def told(plane: Homography, frames: Frames) -> list[str]:
    """What is said about the road."""
    projector = BoxProjector(plane, SIZE)
    projector.traffic.add(frames)
    found = [remark.text for remark in projector.traffic.judge()]
    return [text for text in found if "not the plane" in text]


@pytest.mark.parametrize("grow_px", [0.0, 2.0])
def test_a_flat_road_and_one_whose_boxes_are_too_large_are_the_plane(
    plane: Homography, grow_px: float
) -> None:
    assert told(plane, drive(plane, np.zeros_like, grow_px)) == []


@pytest.mark.parametrize(("top_m", "word"), [(2.5, "higher"), (-2.5, "lower")])
def test_a_crest_and_a_dip_are_told_with_their_place(
    plane: Homography, top_m: float, word: str
) -> None:
    def bump(distance_m: Array) -> Array:
        return np.asarray(top_m * np.exp(-0.5 * ((distance_m - 80.0) / 12.0) ** 2))

    found = [text for text in told(plane, drive(plane, bump)) if word in text]
    assert found
    spans = [text.split(": ")[1].split(" m from")[0].split(" to ") for text in found]
    assert all(float(near) < 95.0 and float(far) > 65.0 for near, far in spans)


def test_positions_on_a_crest_are_less_sure_from_when_it_is_known(plane: Homography) -> None:
    def bump(distance_m: Array) -> Array:
        return np.asarray(2.5 * np.exp(-0.5 * ((distance_m - 80.0) / 12.0) ** 2))

    frames = drive(plane, bump)
    projector, plain = BoxProjector(plane, SIZE), BoxProjector(plane, SIZE)
    whole = projector.project_block(frames)
    alone = plain.place_block(frames)
    assert len(whole.rows) == len(alone.rows)
    more = whole.rows["sigma"] - alone.rows["sigma"]
    assert (more >= 0.0).all()
    assert more[: len(more) // 4].max() == 0.0, "before anything was known"
    assert more[3 * len(more) // 4 :].max() > 3.0, "a tenth of 80 m"
    one_by_one = BoxProjector(plane, SIZE)
    rows = [
        one_by_one.project(int(frames.stamp_ns[k]), frames.frame(k)) for k in range(len(frames))
    ]
    assert np.concatenate(rows).tobytes() == whole.rows.tobytes()


def test_the_height_is_that_of_the_road() -> None:
    """Sides that look larger by H / (H - h)."""
    assert Stretch(60.0, 80.0, np.log(12.0 / 11.0), 0.01).height_m(12.0) == pytest.approx(1.0)
    assert Stretch(60.0, 80.0, np.log(12.0 / 13.0), 0.01).height_m(12.0) == pytest.approx(-1.0)


def test_few_cars_say_nothing() -> None:
    track = np.repeat(np.arange(5), 40)
    assert road_stretches(track, np.tile(np.linspace(20.0, 120.0, 40), 5), np.zeros(200)) == []
    assert road_stretches(np.empty(0, int), np.empty(0), np.empty(0)) == []
