"""What a calibration file says about its camera: written, read back, scaled, refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cameras import Camera

from geoorbit_ros.calibration.camera_facts import CameraFacts
from geoorbit_ros.calibration.control_point_file import read_control_points
from geoorbit_ros.calibration.control_point_writer import control_points_text, write_control_points
from geoorbit_ros.calibration.control_points import ControlPoints
from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.calibration.lens import Lens
from geoorbit_ros.calibration.plausibility import calibration_report
from geoorbit_ros.core.errors import CalibrationError

SIZE = (1920, 1080)
LENS = Lens(1500.0, 1490.0, 970.0, 530.0, SIZE, -0.2, 0.05, 1e-3, -2e-3, 0.01)
FACTS = CameraFacts(SIZE, LENS, 0.03, north_known=False)


def distorted_points() -> ControlPoints:
    points = Camera().control_points()
    return replace(points, pixel=LENS.distort(points.pixel), facts=FACTS)


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    points = replace(Camera().control_points(), datum=Datum(43.0, -89.4), facts=FACTS)
    sigma_px, sigma_m = np.full(len(points), np.nan), np.full(len(points), 0.02)
    sigma_px[3] = 4.0
    points = replace(points, sigma_px=sigma_px, sigma_m=sigma_m)
    write_control_points(tmp_path / "calibration.csv", points, ["made by a test"])
    back = read_control_points(tmp_path / "calibration.csv", Datum(43.0, -89.4))
    assert back.facts == FACTS
    assert back.image_size == SIZE
    np.testing.assert_allclose(back.pixel, points.pixel, atol=1e-5)
    np.testing.assert_allclose(back.local_m, points.local_m, atol=2e-4)
    np.testing.assert_array_equal(back.sigma_px, sigma_px)
    np.testing.assert_array_equal(back.sigma_m, sigma_m)
    assert not back.report.remarks


def test_points_of_a_larger_image_are_scaled_and_told(tmp_path: Path) -> None:
    file = tmp_path / "calibration.csv"
    write_control_points(file, distorted_points())
    full, half = (
        read_control_points(file, image_size=SIZE),
        read_control_points(file, image_size=(960, 540)),
    )
    np.testing.assert_allclose(half.pixel, full.pixel / 2, atol=1e-9)
    assert half.facts.lens == LENS.scaled((960, 540))
    assert any("scaled to 960x540" in text for text in half.report.sentences())
    assert not full.report.remarks
    a, b = fit_homography(full), fit_homography(half)
    pixel = np.array([[700.0, 600.0], [1200.0, 900.0]])
    np.testing.assert_allclose(a.to_ground(pixel), b.to_ground(pixel / 2), atol=0.02)


def test_points_of_an_image_of_another_shape_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "calibration.csv"
    write_control_points(file, distorted_points())
    with pytest.raises(CalibrationError, match=r"1920x1080.*640x640"):
        read_control_points(file, image_size=(640, 640))


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("# lens: fisheye 1500 1500 960 540 0.1", "plumb_bob fx fy"),
        ("# lens: plumb_bob 1500 1500 960 540 minus", "plumb_bob fx fy"),
        ("# lens: plumb_bob 1500 1500 960 540 -0.2 0 0 7", "p2"),
        ("# image_size: large", "WIDTHxHEIGHT"),
        ("# scale_sigma: 3", "0.03"),
        ("# north: up", "unknown"),
    ],
)
def test_a_fact_that_cannot_be_read_is_refused(tmp_path: Path, line: str, words: str) -> None:
    file = tmp_path / "calibration.csv"
    size = "# image_size: 1920x1080\n" * ("image_size" not in line)
    file.write_text(f"{size}{line}\n{control_points_text(Camera().control_points())}")
    with pytest.raises(CalibrationError, match=words):
        read_control_points(file)


def test_a_common_error_of_the_scale_is_the_same_share_of_every_distance() -> None:
    points = replace(Camera().control_points(), facts=CameraFacts(scale_sigma=0.05))
    exact = fit_homography(points, 1e-4, 1e-4)
    pixel = np.array([[700.0, 700.0], [1200.0, 900.0], [960.0, 650.0]])
    ground, shift = exact.to_ground(pixel), exact.fit_shifts(pixel)
    for a, b in ((0, 1), (0, 2), (1, 2)):
        way = ground[b] - ground[a]
        changes = (shift[b] - shift[a]) @ way / (way @ way)
        assert np.linalg.norm(changes) == pytest.approx(0.05, rel=0.01)


def test_a_point_counts_by_its_own_sigma() -> None:
    points = Camera().control_points()
    pixel = points.pixel.copy()
    pixel[4] += [3.0, -3.0]
    moved = replace(points, pixel=pixel)
    sigma = np.full(len(points), np.nan)
    sigma[4] = 300.0
    plain, weighed = fit_homography(moved), fit_homography(replace(moved, sigma_px=sigma))
    truth = fit_homography(points)
    off = [
        np.abs(plane.to_ground(points.pixel) - truth.to_ground(points.pixel)).max()
        for plane in (plain, weighed)
    ]
    assert off[1] < 0.01 * off[0]


def written(folder: Path, above: str, below: str = "") -> Path:
    file = folder / "calibration.csv"
    file.write_text(f"{above}{control_points_text(Camera().control_points())}{below}")
    return file


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("# lens: plumb_bob 1500 1500 960 540", "# lens: plumb_bob 900 900 960 540"),
        ("# image_size: 1920x1080", "# image_size: 1280x720"),
        ("# scale_sigma: 0.03", "# Scale sigma = 0.3"),
    ],
)
def test_two_lines_that_contradict_each_other_are_refused(
    tmp_path: Path, first: str, second: str
) -> None:
    assert read_control_points(written(tmp_path, f"{first}\n{first}\n"), image_size=SIZE)
    with pytest.raises(CalibrationError, match="one of them"):
        read_control_points(written(tmp_path, f"{first}\n{second}\n"), image_size=SIZE)


@pytest.mark.parametrize(
    ("above", "below"),
    [
        ("# Image size = 1920X1080 px\n# lens plumb_bob 1500 1490 970 530 -0.2\n", ""),
        ("# image_size: 1920x1080\n# lens: plumb_bob 1500,0 1490,0 970,0 530,0 -0,2\n", ""),
        ("", "# image_size: 1920x1080\n# lens: plumb_bob 1500, 1490, 970, 530, -0.2\n"),
    ],
)
def test_facts_are_read_as_people_write_them(tmp_path: Path, above: str, below: str) -> None:
    found = read_control_points(written(tmp_path, above, below))
    assert found.facts == CameraFacts(SIZE, Lens(1500.0, 1490.0, 970.0, 530.0, SIZE, -0.2))


def test_comments_for_people_are_no_facts(tmp_path: Path) -> None:
    lines = "# lens was changed in May\n# image size of the old camera: 640x480\n"
    assert read_control_points(written(tmp_path, lines)).facts == CameraFacts()


def test_a_lens_of_another_image_size_or_with_a_fold_is_told(tmp_path: Path) -> None:
    odd = written(tmp_path, "# lens: plumb_bob 1500 1500 480 270\n")
    assert "far from the middle" in next(
        read_control_points(odd, image_size=SIZE).report.sentences()
    )
    folded = written(tmp_path, "# image_size: 1920x1080\n# lens: plumb_bob 1500 1500 960 540 -1\n")
    assert "ends within the image" in next(read_control_points(folded).report.sentences())
    nowhere = written(tmp_path, "# lens: plumb_bob 1500 1500 0 0\n")
    with pytest.raises(CalibrationError, match="image_size"):
        read_control_points(nowhere)


def test_points_beyond_the_image_that_their_file_names_are_doubted(tmp_path: Path) -> None:
    file = written(tmp_path, "# image_size: 640x360\n")
    points = read_control_points(file, image_size=SIZE)
    report = calibration_report(fit_homography(points), SIZE)
    assert report.doubtful
    assert any("are they of this image" in text for text in report.sentences())


def test_a_sigma_that_nobody_has_does_not_decide_alone(tmp_path: Path) -> None:
    points = Camera().control_points()
    sigma = np.full(len(points), 1.0)
    sigma[:3] = 1e-12, 1e-300, 1e200
    file = tmp_path / "calibration.csv"
    file.write_text(control_points_text(replace(points, sigma_px=sigma, sigma_m=sigma)))
    found = read_control_points(file)
    assert found.sigma_px is not None
    assert found.sigma_px[:3].tolist() == [0.01, 0.01, 1e4]
    assert "3 of" in next(found.report.sentences())
    near = np.abs(fit_homography(found).to_ground(points.pixel) - points.local_m)
    assert near.max() < 0.01


def test_a_single_point_in_metres_is_not_taken_for_degrees(tmp_path: Path) -> None:
    file = tmp_path / "points.csv"
    file.write_text("pixel_x,pixel_y,x_m,y_m\n640,500,0,20\n640,500,0,20\n")
    found = read_control_points(file, few=True)
    assert found.datum is None
    assert found.local_m.tolist() == [[0.0, 20.0]]
