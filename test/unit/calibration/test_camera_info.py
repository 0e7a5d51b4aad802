"""The lens of ROS' camera_info: read, scaled, refused, and second to the control points' own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cameras import Camera

from geoorbit_ros.calibration.camera_facts import CameraFacts
from geoorbit_ros.calibration.camera_info import behind_lens, read_calibration, read_camera_info
from geoorbit_ros.calibration.control_point_writer import write_control_points
from geoorbit_ros.calibration.homography import fit_homography, plane_of_images
from geoorbit_ros.calibration.lens import Lens
from geoorbit_ros.calibration.plausibility import calibration_report
from geoorbit_ros.core.errors import GeoOrbitError

SIZE = (1920, 1080)
LENS = Lens(1400.0, 1400.0, 960.0, 540.0, SIZE, -0.25, 0.05)
YAML = """\
image_width: 1920
image_height: 1080
camera_name: north
camera_matrix:
  rows: 3
  cols: 3
  data: [1400.0, 0.0, 959.5, 0.0, 1400.0, 539.5, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.25, 0.05, 0.0, 0.0, 0.0]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
"""


def write(folder: Path, text: str = YAML) -> Path:
    file = folder / "camera_info.yaml"
    file.write_text(text)
    return file


def test_the_file_of_camera_calibration_is_read(tmp_path: Path) -> None:
    assert read_camera_info(write(tmp_path)) == LENS


def test_a_file_without_distortion_has_a_focal_length(tmp_path: Path) -> None:
    lens = read_camera_info(write(tmp_path, YAML[: YAML.index("distortion_model")]))
    assert lens.straight
    assert lens.fx == 1400.0


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("plumb_bob", "equidistant", "equidistant"),
        ("plumb_bob", "rational_polynomial", ""),
        ("[-0.25, 0.05, 0.0, 0.0, 0.0]", "[-0.2, 0.05, 0, 0, 0, 0.1, 0, 0]", "8 coefficients"),
        ("1400.0, 0.0, 959.5", "0.0, 0.0, 959.5", "calibrated"),
        ("[1400.0, 0.0, 959.5,", "[", "6 numbers"),
        ("image_width", "width", "image_width"),
        ("-0.25", "-25", "k1"),
    ],
)
def test_what_is_no_lens_of_ours_is_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    file = write(tmp_path, YAML.replace(old, new))
    if not words:  # the larger model with the numbers of the smaller one
        assert read_camera_info(file) == LENS
        return
    with pytest.raises(GeoOrbitError, match=words):
        read_camera_info(file)


def test_points_are_seen_through_the_lens_of_the_other_file(tmp_path: Path) -> None:
    ideal = Camera().control_points()
    points = replace(ideal, pixel=LENS.distort(ideal.pixel))
    write_control_points(tmp_path / "calibration.csv", points)
    plane = fit_homography(read_calibration(tmp_path / "calibration.csv", write(tmp_path)))
    np.testing.assert_allclose(plane.to_ground(points.pixel), ideal.local_m, atol=0.01)
    half = plane_of_images(plane, (960, 540))
    np.testing.assert_allclose(half.to_ground(points.pixel / 2), ideal.local_m, atol=0.01)
    assert plane_of_images(plane, SIZE) is plane


def test_the_lens_of_the_control_points_goes_first_and_the_other_is_told() -> None:
    ideal = Camera().control_points()
    own = replace(ideal, facts=CameraFacts(SIZE, LENS), image_size=SIZE)
    other = replace(LENS, k1=-0.1)
    assert behind_lens(own, LENS, "camera_info") is own
    assert not own.report.remarks
    assert behind_lens(own, other, "camera_info").facts.lens == LENS
    assert "another lens" in own.report.remarks[-1].text


def test_a_lens_of_smaller_images_is_scaled_and_one_of_others_refused() -> None:
    points = replace(Camera().control_points(), image_size=SIZE)
    found = behind_lens(points, LENS.scaled((640, 360)), "camera_info")
    assert found.facts.lens == LENS
    assert "scaled" in points.report.remarks[-1].text
    with pytest.raises(GeoOrbitError, match="640x480"):
        behind_lens(points, LENS.scaled((640, 480)), "camera_info")


def test_a_focal_length_of_another_zoom_is_told_and_not_used() -> None:
    points = replace(Camera(focal_px=1400.0).control_points(), image_size=SIZE)
    zoomed = Lens(4000.0, 4000.0, 960.0, 540.0, SIZE)
    plane = fit_homography(behind_lens(points, zoomed, "camera_info"))
    report = calibration_report(plane, SIZE)
    assert report.doubtful
    assert any("4000 px" in text and "1400 ±" in text for text in report.sentences())


MESSAGE = """\
header: {frame_id: north}
height: 1080
width: 1920
distortion_model: plumb_bob
d: [-0.25, 0.05, 0.0, 0.0, 0.0]
k: [1400.0, 0.0, 959.5, 0.0, 1400.0, 539.5, 0.0, 0.0, 1.0]
roi: {x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false}
---
"""


def test_a_message_as_it_is_printed_is_read(tmp_path: Path) -> None:
    assert read_camera_info(write(tmp_path, MESSAGE)) == LENS
    part = MESSAGE.replace("x_offset: 0", "x_offset: 64").replace("width: 0", "width: 960")
    with pytest.raises(GeoOrbitError, match=r"region of interest.*\(64, 0\).*1920x1080"):
        read_camera_info(write(tmp_path, part))


@pytest.mark.parametrize(
    "matrix",
    [
        "[1400.0, 0.0, 0.0, 0.0, 1400.0, 0.0, 959.5, 539.5, 1.0]",
        "[1400.0, 40.0, 959.5, 0.0, 1400.0, 539.5, 0.0, 0.0, 1.0]",
        "[1400.0, 0.0, 959.5, 0.0, 1400.0, 539.5, 0.0, 0.0, 0.0]",
    ],
)
def test_a_matrix_of_another_form_is_refused(tmp_path: Path, matrix: str) -> None:
    text = YAML.replace("[1400.0, 0.0, 959.5, 0.0, 1400.0, 539.5, 0.0, 0.0, 1.0]", matrix)
    with pytest.raises(GeoOrbitError, match="fx, 0, cx; 0, fy, cy; 0, 0, 1"):
        read_camera_info(write(tmp_path, text))
