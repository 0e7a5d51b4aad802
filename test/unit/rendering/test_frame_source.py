"""A scene as a source of images: the same text, the same images; a wrong one, a sentence."""

import re

import numpy as np
import pytest

from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.rendering.conditions import Conditions
from geoorbit_ros.rendering.frame_source import SCENES, read_scene_spec
from geoorbit_ros.rendering.rendered_scene import render_scene
from geoorbit_ros.scenes.scene import load_scene
from geoorbit_ros.storage.frames.open_source import open_frame_source
from geoorbit_ros.storage.frames.source import SourceOptions

SPEC = "scene:straight_3x3?seed=4&duration=1&fps=5&size=160x160&light=dusk"


@pytest.fixture(scope="module")
def expected() -> list[np.ndarray]:
    conditions = Conditions("dusk")
    rendered = render_scene(load_scene("straight_3x3"), 1.0, 4, conditions, 5.0, (160, 160))
    return [frame.image for frame in rendered]


def test_the_source_gives_the_images_of_the_scene_at_their_times_and_again(
    expected: list[np.ndarray],
) -> None:
    start_ns = 7 * 10**18
    with open_frame_source(SPEC, SourceOptions(start_ns=start_ns), SCENES) as source:
        assert (source.frame_count, source.fps) == (5, 5.0)
        found = list(source)
        assert [stamp for stamp, _ in found] == [start_ns + k * 200_000_000 for k in range(5)]
        assert all(np.array_equal(a[1], b) for a, b in zip(found, expected, strict=True))
        again = iter(source)
        assert np.array_equal(next(again)[1], expected[0])
        source.close()
        assert list(again) == []


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ("scene:nowhere", ("nowhere",)),
        ("scene:straight_3x3?sid=3", ("'sid'", "seed, duration")),
        ("scene:straight_3x3?seed=x", ("'seed'", "'x'", "a whole number")),
        ("scene:straight_3x3?seed=1.5", ("'seed'", "a whole number")),
        ("scene:straight_3x3?duration=-1", ("duration", "-1")),
        ("scene:straight_3x3?seed=-1", ("seed", "-1", "2147483647")),
        ("scene:straight_3x3?size=99999x99999", ("image width", "99999")),
        ("scene:straight_3x3?seed=1&seed=2", ("'seed' more than once",)),
        ("scene:straight_3x3?size=big", ("'size'", "1280x720")),
        ("scene:straight_3x3?rain=maybe", ("'rain'", "'maybe'", "true")),
        ("scene:straight_3x3?light=noon", ("'light'", "'noon'", "day, dusk, night")),
        ("scene:straight_3x3?clouds=nan", ("clouds", "nan")),
    ],
)
def test_a_wrong_setting_is_one_sentence(spec: str, words: tuple[str, ...]) -> None:
    with pytest.raises(GeoOrbitError) as caught:
        open_frame_source(spec, more=SCENES)
    assert "\n" not in str(caught.value)
    assert all(word in str(caught.value) for word in words), str(caught.value)
    with pytest.raises(GeoOrbitError, match=re.escape(words[0])):
        read_scene_spec(spec)  # nothing is rendered to find it
