"""Images from files, folders and streams: every frame, at its time, or one sentence."""

import re
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from mjpeg_server import MjpegServer, grey_image

from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.storage.frames import open_source
from geoorbit_ros.storage.frames.open_source import open_frame_source
from geoorbit_ros.storage.frames.source import START_NS, FrameSourceError, SourceOptions, to_bgr8

FPS = 20.0
LEVELS = range(10, 250, 20)


def write_video(
    path: Path, code: str = "mp4v", fps: float = FPS, images: list[np.ndarray] | None = None
) -> Path:
    writer = cv2.VideoWriter(
        str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*code), fps, (160, 120)
    )
    for image in images or [grey_image(level) for level in LEVELS]:
        writer.write(image)
    writer.release()
    return path


def write_images(folder: Path, names: list[str]) -> Path:
    folder.mkdir(exist_ok=True)
    for k, name in enumerate(names):
        assert cv2.imwrite(str(folder / name), grey_image(10 * k))
    return folder


def levels_of(images: list[np.ndarray]) -> list[float]:
    return [float(image.mean()) for image in images]


@pytest.mark.parametrize(("suffix", "code"), [("mp4", "mp4v"), ("avi", "MJPG"), ("webm", "VP80")])
def test_a_video_gives_every_frame_in_order_at_its_time(
    tmp_path: Path, suffix: str, code: str
) -> None:
    path = write_video(tmp_path / f"video.{suffix}", code)
    with open_frame_source(str(path)) as source:
        assert (source.fps, source.frame_count, source.live) == (FPS, len(LEVELS), False)
        first, second = list(source), list(source)
    stamps = [stamp for stamp, _ in first]
    expected = START_NS + np.arange(len(LEVELS)) * 1e9 / FPS
    assert np.abs(np.array(stamps) - expected).max() <= 1e6  # WebM counts milliseconds
    assert levels_of([image for _, image in first]) == pytest.approx(list(LEVELS), abs=5.0)
    assert [stamp for stamp, _ in second] == stamps, "a second reading starts at the beginning"


def test_the_first_stamp_is_the_one_asked_for(tmp_path: Path) -> None:
    path = write_video(tmp_path / "video.mp4")
    options = SourceOptions(start_ns=1_700_000_000_123_456_789)
    with open_frame_source(str(path), options) as source:
        assert next(iter(source))[0] == options.start_ns


def test_a_closed_source_ends(tmp_path: Path) -> None:
    with open_frame_source(str(write_video(tmp_path / "video.mp4"))) as source:
        frames = iter(source)
        next(frames)
        source.close()
        assert list(frames) == []


def test_a_folder_is_sorted_by_numbers_and_timed_by_its_rate(tmp_path: Path) -> None:
    folder = write_images(tmp_path / "images", ["f_9.png", "f_10.png", "f_11.png"])
    (folder / "notes.txt").write_text("not an image")
    with open_frame_source(str(folder), SourceOptions(fps=10.0)) as source:
        frames = list(source)
    assert [stamp for stamp, _ in frames] == [START_NS + k * 10**8 for k in range(3)]
    assert levels_of([image for _, image in frames]) == [0.0, 10.0, 20.0]


@pytest.mark.parametrize(
    ("names", "stamps_ns"),
    [
        (["1700000000.5.png", "1700000001.125.png"], [1700000000500000000, 1700000001125000000]),
        (["a-1700000000500.png", "a-1700000000540.png"], [1700000000500 * 10**6] * 2),
        (["n_1700000000_000000001.png"], [1700000000000000001]),
        (["1700000000000000001.jpg"], [1700000000000000001]),
    ],
)
def test_times_in_file_names_are_stamps(
    tmp_path: Path, names: list[str], stamps_ns: list[int]
) -> None:
    if names[0].startswith("a-"):
        stamps_ns = [stamps_ns[0], stamps_ns[0] + 40 * 10**6]
    with open_frame_source(str(write_images(tmp_path / "images", names))) as source:
        assert [stamp for stamp, _ in source] == stamps_ns


def test_grey_16_bit_and_transparent_images_become_8_bit_colour(tmp_path: Path) -> None:
    level = 0x5A
    images: dict[str, np.ndarray] = {
        "1.png": np.full((8, 16), level, np.uint8),
        "2.png": np.full((8, 16), level << 8 | 0x33, np.uint16),
        "3.png": np.full((8, 16, 3), level << 8, np.uint16),
        "4.png": np.full((8, 16, 4), level, np.uint8),
    }
    for name, image in images.items():
        assert cv2.imwrite(str(tmp_path / name), image)
    with open_frame_source(str(tmp_path), SourceOptions(fps=1.0)) as source:
        converted = [image for _, image in source]
    assert len(converted) == 4
    for image in converted:
        assert image.shape == (8, 16, 3)
        assert image.dtype == np.uint8
        assert np.all(image == level)


@pytest.mark.parametrize(
    "image",
    [np.zeros((4, 4), np.float32), np.zeros((4, 4, 2), np.uint8), np.zeros((0, 4, 3), np.uint8)],
)
def test_other_arrays_are_refused(image: np.ndarray) -> None:
    with pytest.raises(FrameSourceError, match="expected grey or colour"):
        to_bgr8(image, "here")


def cut(path: Path, share: float) -> Path:
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    return path


def refusal(spec: str, options: SourceOptions | None = None) -> str:
    with pytest.raises(GeoOrbitError) as caught, open_frame_source(spec, options) as source:
        list(source)
    text = str(caught.value)
    assert "\n" not in text
    return text


def test_a_file_that_is_no_video_is_one_sentence(tmp_path: Path) -> None:
    noise = tmp_path / "noise.mp4"
    noise.write_bytes(np.random.default_rng(1).bytes(5000))
    (tmp_path / "empty.mp4").touch()
    (tmp_path / "folder").mkdir()
    assert "no such file" in refusal(str(tmp_path / "absent.mp4"))
    assert "5000 bytes that are no video" in refusal(str(noise))
    assert "0 bytes" in refusal(str(tmp_path / "empty.mp4"))
    assert "no image" in refusal(str(tmp_path / "folder"))
    assert "nothing" in refusal(" ")


def test_ffmpeg_and_opencv_add_nothing_to_the_sentence(tmp_path: Path) -> None:
    path = cut(write_video(tmp_path / "cut.mp4"), 0.5)
    # A process of its own: FFmpeg reads its log level once.
    program = (
        "import sys\nfrom geoorbit_ros.storage.frames.open_source import open_frame_source\n"
        "try:\n    open_frame_source(sys.argv[1])\nexcept Exception as e:\n    print(e)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(path)], capture_output=True, text=True, timeout=60
    )
    assert done.stdout.startswith(f"{path}: found {path.stat().st_size} bytes that are no video")
    assert (done.stdout.count("\n"), done.stderr) == (1, "")


def test_a_video_that_breaks_off_is_told_from_one_that_ends(tmp_path: Path) -> None:
    random = np.random.default_rng(1)
    images = [random.integers(0, 255, (120, 160, 3), dtype=np.uint8) for _ in range(20)]
    path = write_video(tmp_path / "long.avi", "MJPG", 2.0, images)
    with open_frame_source(str(path)) as source:
        assert len(list(source)) == 20
    assert re.search(r"breaks off after [45]\.\d of 10\.0 s", refusal(str(cut(path, 0.5))))


def test_an_unreadable_image_and_one_of_another_size_are_named(tmp_path: Path) -> None:
    folder = write_images(tmp_path / "images", ["1.png", "2.png", "3.png"])
    (folder / "2.png").write_bytes(b"no image")
    options = SourceOptions(fps=1.0)
    assert "2.png: found no readable image" in refusal(str(folder), options)
    cv2.imwrite(str(folder / "2.png"), grey_image(1, (80, 60)))
    text = refusal(str(folder), options)
    assert "2.png: found a frame of 80x60 pixels, expected 160x120 as before" in text


def test_who_takes_bad_frames_gets_the_rest(tmp_path: Path) -> None:
    folder = write_images(tmp_path / "images", ["1.png", "2.png", "3.png"])
    (folder / "2.png").write_bytes(b"no image")
    bad: list[FrameSourceError] = []
    options = SourceOptions(fps=1.0, on_bad_frame=bad.append)
    with open_frame_source(str(folder), options) as source:
        stamps = [stamp for stamp, _ in source]
    assert stamps == [START_NS, START_NS + 2 * 10**9]
    assert len(bad) == 1


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (["frame_1.png"], "frame_1.png, expected frames per second"),
        (["b_1700000000.png", "c_1600000000.png"], "names whose order is that of their times"),
    ],
)
def test_a_folder_without_times_asks_for_a_rate(
    tmp_path: Path, names: list[str], words: str
) -> None:
    assert words in refusal(str(write_images(tmp_path / "images", names)))


@pytest.mark.parametrize("fps", [0.0, -1.0, float("nan"), 1e6])
def test_a_rate_must_be_one(tmp_path: Path, fps: float) -> None:
    assert "frames per second" in refusal(str(tmp_path), SourceOptions(fps=fps))


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(open_source, "FIRST_WAIT_S", 0.01)


@pytest.mark.usefixtures("quick")
def test_a_stream_that_ends_or_stalls_is_opened_again() -> None:
    said: list[str] = []
    options = SourceOptions(
        stall_timeout_s=2.0, give_up_s=None, report=said.append, clock_ns=time.monotonic_ns
    )
    first, second, third = ([grey_image(level)] * 5 for level in (10, 100, 200))
    frames = []
    with (
        MjpegServer(first, second, third) as server,
        open_frame_source(server.address, options) as source,
    ):
        for frame in source:
            frames.append(frame)
            if float(frame[1].mean()) > 150.0:
                break
        assert (source.live, source.reconnects) == (True, 2)
    levels = np.round(levels_of([image for _, image in frames]), -1).astype(int).tolist()
    assert levels == sorted(levels)
    assert min(levels.count(10), levels.count(100)) >= 4, "the last one may be cut"
    assert np.all(np.diff([stamp for stamp, _ in frames]) > 0)
    assert sum("receiving frames" in sentence for sentence in said) == 3
    assert sum("no more frames, opening it again in 0.01 s" in s for s in said) == 2


@pytest.mark.usefixtures("quick")
def test_a_stream_that_never_answers_is_given_up_in_one_sentence() -> None:
    with MjpegServer() as server:
        options = SourceOptions(open_timeout_s=0.5, give_up_s=0.1)
        address = server.address.replace("http://", "http://user:secret@") + "?token=secret"
        text = refusal(address, options)
        assert server.opened > 1, "it was tried again before"
    assert "no answer for" in text
    assert "secret" not in text


def test_pauses_between_attempts_double_up_to_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(open_source, "FIRST_WAIT_S", 0.001)
    monkeypatch.setattr(open_source, "LONGEST_WAIT_S", 0.004)
    said: list[str] = []
    with MjpegServer() as server:
        options = SourceOptions(open_timeout_s=0.5, give_up_s=None, report=said.append)
        source = open_frame_source(server.address, options)

        def note(sentence: str) -> None:
            said.append(sentence.rpartition(" in ")[2])
            if len(said) == 5:
                source.close()

        object.__setattr__(options, "report", note)
        assert list(source) == []
    assert said == ["0.001 s", "0.002 s", "0.004 s", "0.004 s", "0.004 s"]
