"""Another view is noticed in the images alone; traffic, light and wind are none."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from geoorbit_ros.detection.view_watch import ViewChanges

Image = NDArray[np.uint8]


def scenery(seed: int) -> Image:
    """A textured picture, larger than the camera's view."""
    noise = np.random.default_rng(seed).normal(0.0, 1.0, (420, 720))
    soft = sum(cv2.GaussianBlur(noise, (0, 0), sigma) * sigma for sigma in (1.0, 2.0, 4.0))
    grey = np.clip(128.0 + 45.0 * soft / np.std(soft), 0, 255).astype(np.uint8)
    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), np.uint8)


def view(of: Image, right: float = 0.0, down: float = 0.0) -> Image:
    """What a camera sees of it, with the image moved by so many pixels."""
    matrix = np.array([[1.0, 0.0, right - 40.0], [0.0, 1.0, down - 30.0]])
    return np.asarray(cv2.warpAffine(of, matrix, (640, 360)), np.uint8)


def watch(images: list[Image]) -> list[tuple[float, str]]:
    """Seconds and sentences; the images come ten times a second."""
    changes = ViewChanges()
    for k, image in enumerate(images):
        changes.look(round(1e9 + 1e8 * k), image)
    return [((stamp_ns - 10**9) / 1e9, sentence) for stamp_ns, sentence in changes.found]


def test_a_bump_is_told_with_its_pixels() -> None:
    place = scenery(1)
    [(time_s, sentence)] = watch([view(place)] * 60 + [view(place, 12.0, -8.0)] * 60)
    assert 6.0 <= time_s <= 6.5
    assert sentence == "the image has moved by 12 px to the right and 8 px up"


def test_a_cut_is_told_and_so_is_the_way_back() -> None:
    here, there = view(scenery(1)), view(scenery(2))
    found = watch([here] * 60 + [there] * 60 + [here] * 60)
    assert [sentence for _, sentence in found] == ["the camera shows another view"] * 2
    assert [time_s for time_s, _ in found] == pytest.approx([6.0, 12.0], abs=0.5)


def test_light_wind_flashes_and_lorries_are_no_other_view() -> None:
    place = scenery(1)
    dimmed = [np.asarray(view(place) * (1.0 - 0.004 * k), np.uint8) for k in range(150)]
    assert watch(dimmed) == []
    swaying = [view(place, 2.0 * np.sin(0.8 * k), 2.0 * np.cos(0.6 * k)) for k in range(150)]
    assert watch(swaying) == []
    flash = [view(place)] * 30 + [np.full((360, 640, 3), 255, np.uint8)] * 8 + [view(place)] * 30
    assert watch(flash) == []
    lorry = [view(place) for _ in range(90)]
    for k, image in enumerate(lorry):
        left = 12 * k - 300
        image[60:340, max(left, 0) : max(left + 300, 0)] = (40, 60, 200)
    assert watch(lorry) == []
