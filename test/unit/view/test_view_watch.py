"""A moved camera is noticed and measured in its images alone; traffic, light and wind are none."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.view.looks import Blindness, ViewLook, ViewState
from geoorbit_ros.view.memory import load_places, named_files, preset_places, save_places
from geoorbit_ros.view.picture import displacement, shifted, size_of_move
from geoorbit_ros.view.watch import ViewWatch

Image = NDArray[np.uint8]
SIZE = (640, 360)
EXACT_PX = 0.15
"""Motions of drawn images are known to this."""


def scenery(seed: int) -> Image:
    """A textured picture, larger than the camera's view."""
    noise = np.random.default_rng(seed).normal(0.0, 1.0, (500, 800))
    soft = sum(cv2.GaussianBlur(noise, (0, 0), sigma) * sigma for sigma in (1.5, 3.0, 6.0))
    grey = np.clip(128.0 + 45.0 * soft / np.std(soft), 0, 255).astype(np.uint8)
    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), np.uint8)


HERE, THERE = scenery(1), scenery(2)
GRAINS = [np.random.default_rng(k).normal(0.0, 2.0, (360, 640, 1)) for k in range(5)]


def bump(
    right: float, down: float, turn_deg: float = 0.0, zoom: float = 1.0
) -> NDArray[np.float64]:
    matrix = np.eye(3)
    matrix[:2] = cv2.getRotationMatrix2D((319.5, 179.5), turn_deg, zoom)
    return np.asarray(shifted(right, down) @ matrix)


def view(of: Image, motion: NDArray[np.float64] | None = None) -> Image:
    """What a camera sees of it, with the image moved, and its noise."""
    matrix = (np.eye(3) if motion is None else motion) @ shifted(-80.0, -70.0)
    shown = cv2.warpPerspective(of, matrix, SIZE).astype(np.int16)
    grains = GRAINS[int(matrix[0, 2] * 1000) % len(GRAINS)]
    return np.clip(shown + grains, 0, 255).astype(np.uint8)


def watch(
    image_at: Callable[[float], Image], seconds: float, watcher: ViewWatch | None = None
) -> list[tuple[float, ViewLook]]:
    """Looks with their times; there are ten images a second."""
    watcher, looks = watcher or ViewWatch(), []
    for k in range(round(10 * seconds)):
        stamp_ns = 10**9 + k * 10**8
        if watcher.due(stamp_ns):
            looks.append((k / 10, watcher.look(stamp_ns, image_at(k / 10))))
    return looks


def states(looks: list[tuple[float, ViewLook]]) -> list[ViewState]:
    """States in their order, each once in a row."""
    found = [look.state for _, look in looks]
    return [state for k, state in enumerate(found) if not k or state is not found[k - 1]]


@pytest.mark.parametrize(
    "motion",
    [bump(1.5, 0.0), bump(-4.0, 3.0), bump(20.0, -12.0, 1.0, 1.02), bump(-30.0, 5.0, -1.0, 0.98)],
)
def test_a_bump_is_noticed_within_three_seconds_and_measured(motion: NDArray[np.float64]) -> None:
    looks = watch(lambda t: view(HERE, motion if t >= 12.0 else None), 20.0)
    assert states(looks) == [ViewState.UNKNOWN, ViewState.STEADY, ViewState.MOVED]
    noticed = next(t for t, look in looks if look.state is ViewState.MOVED)
    assert 12.0 <= noticed <= 15.0
    for t, look in looks:
        if t >= 13.0:
            off = look.motion @ np.linalg.inv(motion)
            assert look.usable
            assert size_of_move(off / off[2, 2], SIZE) < EXACT_PX
    assert (looks[-1][1].since_ns - 10**9) / 1e9 == pytest.approx(12.0, abs=0.5)


def test_half_of_the_image_behind_traffic_moves_nothing() -> None:
    rng = np.random.default_rng(5)

    def busy(_: float) -> Image:
        image = view(HERE)
        for _ in range(12):
            x, y = rng.integers(0, 540), rng.integers(60, 290)
            image[y : y + 60, x : x + 90] = rng.integers(0, 255, 3)
        return image

    looks = watch(busy, 25.0)
    assert all(look.moved_px < 0.3 for _, look in looks)
    assert states(looks)[-1] is ViewState.STEADY
    assert ViewState.OTHER_VIEW not in states(looks)


def test_light_that_goes_and_comes_is_no_event() -> None:
    looks = watch(lambda t: np.asarray(view(HERE) * (0.55 + 0.45 * np.cos(t / 3)), np.uint8), 25.0)
    assert states(looks) == [ViewState.UNKNOWN, ViewState.STEADY]
    assert max(look.moved_px for _, look in looks) < 0.5


def test_shaking_is_measured_at_each_look_and_the_middle_is_the_reference() -> None:
    def swing(t: float) -> NDArray[np.float64]:
        return shifted(3.0 * np.sin(2.0 * np.pi * 0.9 * t), 0.0)

    looks = watch(lambda t: view(HERE, swing(t)), 25.0)
    assert states(looks)[-1] is ViewState.SHAKING
    off = [displacement(look.motion, SIZE)[0, 0] - swing(t)[0, 2] for t, look in looks if t > 10.0]
    assert np.abs(off).max() < 0.5, "of a sway of three pixels"


def test_drift_is_followed_and_never_becomes_the_view() -> None:
    def drift(t: float) -> NDArray[np.float64]:
        return shifted(max(t - 10.0, 0.0) * 0.1, 0.0)

    looks = watch(lambda t: view(HERE, drift(t)), 60.0)
    assert looks[-1][1].state is ViewState.MOVED
    assert looks[-1][1].moved_px == pytest.approx(5.0, abs=0.3)


def test_away_and_back_is_another_view_and_then_the_same() -> None:
    watcher = ViewWatch()
    looks = watch(
        lambda t: view(THERE if 12.0 <= t < 26.0 or 34.0 <= t < 40.0 else HERE), 46.0, watcher
    )
    told = next(t for t, look in looks if look.state is ViewState.OTHER_VIEW)
    assert 12.0 <= told <= 15.0
    views = [look.view for t, look in looks if 28.0 <= t < 33.0 or t > 42.0]
    assert set(views) == {0}
    again = {look.view for t, look in looks if 36.0 <= t < 40.0}
    assert again == {
        looks[[t for t, _ in looks].index(next(t for t, _ in looks if t > 25.0))][1].view
    }
    assert all(not look.usable or look.view != 0 for t, look in looks if 12.6 <= t < 25.9)
    assert len(watcher.places) == 2


@pytest.mark.parametrize("what", ["black", "fog"])
def test_an_image_that_shows_nothing_is_blind(what: str) -> None:
    def shown(t: float) -> Image:
        image = view(HERE)
        if 12.0 <= t < 20.0:
            fog = np.asarray(cv2.GaussianBlur(image, (0, 0), 40.0), np.uint8)
            image = fog if what == "fog" else np.asarray(image // 250, np.uint8)
        return image

    looks = watch(shown, 26.0)
    between = [look for t, look in looks if 13.0 <= t < 19.9]
    assert {look.state for look in between} == {ViewState.BLIND}
    assert {look.blindness for look in between} == {Blindness.NO_PATTERN}
    assert not any(look.usable for look in between)
    assert looks[-1][1].state is ViewState.STEADY


def note(watcher: ViewWatch, images: list[bytes]) -> list[Blindness]:
    said = []
    for k, data in enumerate(images):
        stamp_ns = 10**9 + k * 10**8
        watcher.note(stamp_ns, data)
        said.append(watcher.look(stamp_ns, view(HERE)).blindness if k % 5 == 4 else Blindness.NONE)
    return said


def test_frozen_and_looping_streams_are_blind_and_a_pause_is_not() -> None:
    fresh = [bytes([k // 256, k % 256]) for k in range(100)]
    assert set(note(ViewWatch(), fresh)) == {Blindness.NONE}
    assert set(note(ViewWatch(), fresh[:50] + fresh[49:50] * 20 + fresh[50:])) == {Blindness.NONE}
    assert note(ViewWatch(), fresh[:50] + fresh[49:50] * 60)[-1] is Blindness.FROZEN
    assert note(ViewWatch(), fresh[:60] * 2)[-1] is Blindness.REPEATED
    assert set(note(ViewWatch(repeats_allowed=True), fresh[:60] * 2)) == {Blindness.NONE}


@pytest.mark.parametrize(("what", "frozen"), [("sent anew", True), ("live", False), ("car", False)])
def test_a_dead_stream_that_is_encoded_anew_is_frozen_after_a_minute(
    what: str, frozen: bool
) -> None:
    """Every twelfth image comes with other rounding, as encoders send it; a live one has noise."""
    rng, watcher, picture = np.random.default_rng(4), ViewWatch(), view(HERE)
    for k in range(340):
        image, stamp_ns = picture.copy(), 10**9 + k * 2 * 10**8
        if what == "live" or k % 6 == 0:
            rounding = rng.integers(-1, 2, image.shape).astype(np.int16)
            image = np.clip(image + rounding, 0, 255).astype(np.uint8)
        if what == "car" and 150 < k < 160:
            image[200:216, 20 * k - 2950 : 20 * k - 2920] = 30
        watcher.note(stamp_ns, image[::8, ::8].tobytes())
        if watcher.due(stamp_ns):
            look = watcher.look(stamp_ns, image)
    assert (look.blindness is Blindness.FROZEN) is frozen


def test_after_a_restart_a_bump_is_still_known(tmp_path: Path) -> None:
    before = ViewWatch()
    watch(lambda _: view(HERE), 12.0, before)
    file = tmp_path / "views.npz"
    save_places(file, before.places, SIZE, "calibration 1")
    places, size = load_places(file, "calibration 1")
    looks = watch(lambda _: view(HERE, bump(9.0, 4.0)), 3.0, ViewWatch(places, size))
    assert looks[-1][1].state is ViewState.MOVED
    assert looks[0][1].usable
    assert size_of_move(looks[-1][1].motion @ np.linalg.inv(bump(9.0, 4.0)), SIZE) < EXACT_PX
    with pytest.raises(InputFileError, match="another calibration"):
        load_places(file, "calibration 2")


def test_presets_are_recognised_by_their_pictures(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "left.png"), view(THERE))
    files = named_files(f"left={tmp_path / 'left.png'}", "view_images")
    places, size = preset_places(files)
    looks = watch(lambda t: view(HERE if t < 12.0 else THERE), 18.0, ViewWatch(places, size))
    assert looks[10][1].view == 0
    assert {look.view for t, look in looks if t > 14.0} == {1}
    assert looks[-1][1].state is ViewState.STEADY


def test_a_drift_is_seen_although_all_that_the_image_shows_changes_meanwhile() -> None:
    """Snow, leaves, another sun: references follow the picture, not the camera."""
    noise = np.random.default_rng(0).normal(0.0, 1.0, HERE.shape[:2]).astype(np.float32)
    soft = cv2.GaussianBlur(noise, (0, 0), 12.0)
    order = np.argsort(np.argsort(soft.ravel())).reshape(soft.shape) / soft.size
    watcher, later = ViewWatch(), scenery(7)
    for k in range(300):
        image, motion = HERE.copy(), shifted(0.015 * k, -0.01 * k)
        changed = order < 0.9 * k / 300
        image[changed] = later[changed]
        look = watcher.look((1 + 3 * k) * 10**9, view(image, motion))
    assert len(watcher.places) == 1
    assert len(watcher.places[0].references) > 1
    assert look.state is ViewState.MOVED
    assert size_of_move(look.motion @ np.linalg.inv(motion), SIZE) < 0.4, "of five pixels"


def test_a_stray_image_of_another_size_does_not_become_the_view() -> None:
    scene = scenery(3)
    watcher = ViewWatch()
    for k in range(12):
        watcher.look(k * 10**9, view(scene))
    kept = list(watcher.places)
    small = cv2.resize(view(scene), (320, 180))
    watcher.look(12 * 10**9, np.asarray(small, np.uint8))
    looks = [watcher.look(k * 10**9, view(scene, bump(20.0, 0.0))) for k in range(13, 25)]
    assert watcher.places == kept
    assert looks[-1].state is ViewState.MOVED
    assert looks[-1].moved_px == pytest.approx(20.0, abs=3.0)


def test_files_of_views_may_lie_in_folders_with_blanks(tmp_path: Path) -> None:
    left, right = tmp_path / "my cameras" / "left.png", tmp_path / "right.png"
    found = named_files(f"left={left} right={right}", "parameter 'view_images'")
    assert found == {"left": left, "right": right}
    assert named_files("", "parameter 'view_images'") == {}


def test_any_damage_to_saved_views_is_told(tmp_path: Path) -> None:
    watcher = ViewWatch()
    for k in range(12):
        watcher.look(k * 10**9, view(scenery(4)))
    file = tmp_path / "views.npz"
    assert watcher.size is not None
    save_places(file, watcher.places, watcher.size, "mark")
    good = file.read_bytes()
    assert load_places(file, "mark")[0]
    for at in range(0, len(good), max(1, len(good) // 40)):
        file.write_bytes(good[:at] + bytes(64) + good[at + 64 :])
        try:
            load_places(file, "mark")
        except InputFileError as error:
            assert "views" in str(error) or "format" in str(error)
        file.write_bytes(good[:at])
        with pytest.raises(InputFileError):
            load_places(file, "mark")
    save_places(file, watcher.places, (640, 480), "mark")
    with pytest.raises(InputFileError, match="pictures of"):
        load_places(file, "mark")
