"""The report: complete in itself, the same every time, and it names everything it was given."""

from __future__ import annotations

import base64
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from page_checker import check_page

from geoorbit_ros.calibration.control_points import ControlPoints
from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.core.lanes import CrossSection, Lane, LaneMap
from geoorbit_ros.core.polylines import offset_line
from geoorbit_ros.core.tables import FLAG_TRUNCATED, TRACK_DTYPE, join_frames
from geoorbit_ros.report.lane_drawing import direction_groups
from geoorbit_ros.report.map_frame import fit_map_frame
from geoorbit_ros.report.page import ReportInput, report_html
from geoorbit_ros.report.recording import Recording, sha256
from geoorbit_ros.report.svg import nice_step, path_data


def lane(lane_id: int, y_m: float, *, west: bool = False, status: str = "confirmed") -> Lane:
    center = np.column_stack((np.linspace(20.0, 120.0, 25), np.full(25, y_m)))
    center = center[::-1].copy() if west else center
    return Lane(
        lane_id,
        center,
        offset_line(center, 1.75),
        offset_line(center, -1.75),
        3.5,
        0.11,
        0.93,
        status,  # type: ignore[arg-type]
        17.0,
        4 if status == "tentative" else 0,
        0.07,
    )


def recording() -> Recording:
    kept = Recording()
    frames = []
    for k in range(80):
        rows = np.zeros(2, TRACK_DTYPE)
        rows["track_id"] = (1, 2)
        rows["x"] = (20.0 + 1.25 * k, 120.0 - 1.25 * k)
        rows["y"] = (0.0, 7.0)
        frames.append((k * 100_000_000, rows))
    assert len(list(kept.tee([join_frames(frames, TRACK_DTYPE)]))) == 1
    return kept


def content() -> ReportInput:
    ground = np.array([(x, y) for x in (15.0, 40.0, 80.0, 130.0) for y in (-6.0, 4.0, 12.0)])
    pinhole = np.array([[960.0, -1000.0, 0.0], [300.0, 0.0, 9000.0], [1.0, 0.0, 0.0]])
    pixel = np.column_stack((ground, np.ones(len(ground)))) @ pinhole.T
    points = ControlPoints(
        pixel[:, :2] / pixel[:, 2:], ground, Datum(43.0, -89.0), np.arange(len(ground)) + 2
    )
    section = CrossSection(
        90.0, np.linspace(-5, 5, 60), np.exp(-(np.linspace(-5, 5, 60) ** 2)), np.array([0.0, 3.4])
    )
    lanes = (lane(3, 0.0), lane(12, 3.5, status="tentative"), lane(40, 7.0, west=True))
    visible = np.array([[15.0, -8.0], [130.0, -8.0], [130.0, 14.0], [15.0, 14.0]])
    return ReportInput(
        camera_id="pole <7> & co",
        lane_map=LaneMap(7_900_000_000, lanes, (section,), visible),
        recording=recording(),
        homography=fit_homography(points),
        image_size=(1920, 1080),
        provenance=[("Tracks SHA-256", "abc123")],
        truth=[lane(1, 0.1), lane(2, 30.0)],
    )


@pytest.fixture(scope="module")
def page() -> str:
    return report_html(content())


def test_the_page_is_well_formed_and_needs_nothing_else(page: str) -> None:
    check_page(page)


def test_every_lane_is_in_the_table_and_in_both_drawings(page: str) -> None:
    for lane_id in (3, 12, 40):
        assert f'">{lane_id}</span>' in page
        assert page.count(f'text-anchor="middle">{lane_id}</text>') == 2
    assert "3.50 ± 0.11" in page
    assert "Lane 12 is tentative after 17 vehicles: about 4 more vehicles will confirm it." in page


def test_the_page_says_what_it_was_given(page: str) -> None:
    assert "pole &lt;7&gt; &amp; co" in page
    assert "pole <7>" not in page
    assert "abc123" in page
    assert "1 of 2 lanes found" in page
    assert "12 of 12 control points used" in page
    assert page.count("<h3>Towards E, 90°: 2 peaks</h3>") == 1
    assert "3.40 m" in page  # the distance between the two peaks


def test_lanes_lie_over_the_camera_s_image_which_is_in_the_page() -> None:
    view = np.full((540, 960, 3), (40, 90, 160), np.uint8)
    page = report_html(replace(content(), image=view))
    shown = re.findall(r'href="data:image/jpeg;base64,([^"]+)"', page)
    assert len(shown) == 1
    image = cv2.imdecode(np.frombuffer(base64.b64decode(shown[0]), np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    assert image.shape == view.shape
    assert np.abs(image.astype(int) - view).max() < 8
    assert page.index("data:image/jpeg") < page.index('id="image-clip"')


def test_without_lanes_the_image_and_the_paths_are_there() -> None:
    nothing = replace(content(), lane_map=LaneMap(7_900_000_000, ()), truth=None)
    page = report_html(nothing)
    assert "0 lanes confirmed." in page
    assert 'id="image-clip"' in page
    assert 'class="path"' in page


def test_the_same_input_gives_the_same_page(page: str) -> None:
    assert report_html(content()) == page


def test_the_page_is_there_without_truth_sections_and_visible_range() -> None:
    bare = replace(content(), truth=None)
    bare = replace(bare, lane_map=LaneMap(0, bare.lane_map.lanes))
    html = report_html(bare)
    assert "Compared with the true lanes" not in html
    assert "Across the road" not in html


def test_paths_are_split_where_a_track_jumps_pauses_or_leaves_the_image() -> None:
    kept = Recording()
    frames = []
    for k in range(120):
        rows = np.zeros(1, TRACK_DTYPE)
        rows["track_id"] = 5
        rows["x"] = k + (100.0 if k >= 40 else 0.0)
        rows["flags"] = FLAG_TRUNCATED if k >= 110 else 0
        frames.append((k * 100_000_000 + (5_000_000_000 if k >= 80 else 0), rows))
    list(kept.tee([join_frames(frames, TRACK_DTYPE)]))
    ends = [(p[0, 0], p[-1, 0]) for p in kept.paths()]
    assert ends == [(0.0, 39.0), (140.0, 179.0), (180.0, 209.0)]
    assert all(len(p) < 25 for p in kept.paths()), "thinned to two metres"


def test_jitter_is_no_path() -> None:
    kept = Recording()
    rng = np.random.default_rng(1)
    frames = []
    for k in range(100):
        rows = np.zeros(1, TRACK_DTYPE)
        rows["x"], rows["y"] = rng.normal(scale=0.5, size=2)
        frames.append((k, rows))
    list(kept.tee([join_frames(frames, TRACK_DTYPE)]))
    assert kept.paths() == []


@pytest.mark.parametrize("heading", np.arange(0.0, 360.0, 37.0))
def test_a_long_road_lies_along_the_page_wherever_it_points(heading: float) -> None:
    along = np.array([np.sin(np.radians(heading)), np.cos(np.radians(heading))])
    road = np.linspace(-150, 150, 50)[:, None] * along
    road = np.vstack((road, road + 10 * np.array([-along[1], along[0]])))
    frame = fit_map_frame(road)
    pixel = frame.to_pixel(road)
    assert np.ptp(pixel[:, 0]) > 0.9 * frame.size_px[0]
    assert pixel.min() > 0
    assert np.all(pixel < np.array(frame.size_px))
    left_of_travel = frame.turn @ np.array([-along[1], along[0]])
    forward = frame.turn @ along
    turned_left = forward[0] * left_of_travel[1] - forward[1] * left_of_travel[0]
    assert turned_left == pytest.approx(1.0), "mirrored"


def test_opposite_directions_have_different_colours() -> None:
    colour = direction_groups([lane(1, 0.0), lane(2, 3.5), lane(3, 7.0, west=True)])
    assert colour[1] == colour[2] != colour[3]


def test_path_data_breaks_at_nan() -> None:
    nan = float("nan")
    line = np.array([[0.0, 0.0], [1.0, 2.0], [nan, nan], [3.0, 4.0], [5.0, 6.04]])
    assert path_data(line) == "M0.0 0.0 1.0 2.0M3.0 4.0 5.0 6.0"


@pytest.mark.parametrize(("span", "step"), [(12.0, 2.0), (100.0, 20.0), (0.3, 0.05)])
def test_ticks_are_round(span: float, step: float) -> None:
    assert nice_step(span) == pytest.approx(step)


def test_hash_of_a_folder_depends_on_content_only(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        for file in ("2", "1") if name == "a" else ("1", "2"):
            (tmp_path / name / file).write_text(file)
    assert sha256(tmp_path / "a") == sha256(tmp_path / "b")
    (tmp_path / "b" / "2").write_text("3")
    assert sha256(tmp_path / "a") != sha256(tmp_path / "b")


def test_a_busy_day_stays_a_small_page() -> None:
    kept = Recording()
    vehicles = np.arange(2000)
    frames = []
    for k in range(150):
        rows = np.zeros(len(vehicles), TRACK_DTYPE)
        rows["track_id"], rows["x"], rows["y"] = vehicles, 20.0 + 2.0 * k, vehicles % 9
        frames.append((k * 100_000_000, rows))
    list(kept.tee([join_frames(frames, TRACK_DTYPE)]))
    html = report_html(replace(content(), recording=kept))
    assert "500 of 2000 vehicle paths" in html
    assert len(html) < 3_000_000
