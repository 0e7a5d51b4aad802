"""Video files and folders as people have them: read as meant, used and told, or one sentence."""

import re
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from made_videos import (
    FPS,
    SINCE_1904_S,
    SIZE,
    cut,
    patched,
    with_edit_list,
    with_index_first,
    write_jpeg_stream,
    write_video,
)
from mjpeg_server import grey_image

from geoorbit_ros.core.addresses import is_address
from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.storage.frames.container import read_container
from geoorbit_ros.storage.frames.open_source import open_frame_source
from geoorbit_ros.storage.frames.source import (
    START_NS,
    FrameSource,
    FrameSourceError,
    LeftOut,
    SourceOptions,
)

NAMES = [
    "2024-05-24T08:00:00.mp4",
    "http:film.mp4",
    "frame_%03d.mp4",
    "100% north.mp4",
    "-film.mp4",
    "north road.mp4",
    "Straße [1] {2}?#&;.mp4",
    "北.mp4",
    "film",
]


def read(path: Path | str, options: SourceOptions | None = None) -> tuple[list[float], FrameSource]:
    """Times in seconds from the first image's, and the source."""
    with open_frame_source(str(path), options) as source:
        return [(stamp - START_NS) / 1e9 for stamp, _ in source], source


def said(source: FrameSource) -> str:
    return "\n".join(source.remarks.sentences())


def refusal(path: Path | str, options: SourceOptions | None = None) -> str:
    with pytest.raises(GeoOrbitError) as caught:
        read(path, options)
    text = str(caught.value)
    assert "\n" not in text
    return text


@pytest.mark.parametrize("name", NAMES)
def test_a_video_may_have_any_name(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_video(tmp_path / "plain.mp4").rename(tmp_path / name)
    monkeypatch.chdir(tmp_path)
    for spec in (name, f"./{name}", str(tmp_path / name)):
        times, source = read(spec)
        assert len(times) == 20
        assert said(source) == ""


@pytest.mark.parametrize(
    "name", ["a:b", "%d_%03d", "-x", "ö 北", "[1]*?", b"\xff".decode("utf-8", "surrogateescape")]
)
def test_images_and_their_folder_may_have_any_name(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / name
    folder.mkdir()
    _, jpeg = cv2.imencode(".jpg", grey_image(90, SIZE))
    for k in range(3):
        (folder / f"{name}{k}.jpg").write_bytes(jpeg.tobytes())
    monkeypatch.chdir(tmp_path)
    times, _ = read(name, SourceOptions(fps=2.0))
    assert times == [0.0, 0.5, 1.0]


def test_a_name_that_opencv_would_crash_on_is_refused(tmp_path: Path) -> None:
    path = tmp_path / b"\xff.mp4".decode("utf-8", "surrogateescape")
    write_video(tmp_path / "plain.mp4").rename(path)
    assert "not UTF-8" in refusal(path)


def test_a_file_can_be_named_by_its_url(tmp_path: Path) -> None:
    path = write_video(tmp_path / "plain.mp4").rename(tmp_path / "north road.mp4")
    assert len(read(path.as_uri())[0]) == 20
    assert is_address("RTSP://camera/1")
    assert not is_address("rtsp:film.mp4")


@pytest.mark.parametrize("suffix", [".mp4", ".avi", ".webm", ".mkv"])
def test_a_video_that_breaks_off_is_refused_before_it_is_read(tmp_path: Path, suffix: str) -> None:
    path = write_video(tmp_path / f"film{suffix}", 60, noise=True)
    if suffix == ".mp4":
        with_index_first(path)
    size = path.stat().st_size
    cut(path, 0.5)
    text = refusal(path)
    assert f"of {size} bytes" in text
    said_s = re.search(r"breaks off after (\d\.\d) of 6\.0 s", text)
    assert said_s
    told: list[FrameSourceError] = []
    times, source = read(path, SourceOptions(on_cut=told.append))
    assert 10 <= len(times) <= 50
    assert float(said_s[1]) == pytest.approx(len(times) / FPS, abs=0.3)
    assert len(told) == 1
    assert "what is there is used" in said(source)


def test_a_video_without_its_index_is_named(tmp_path: Path) -> None:
    text = refusal(cut(write_video(tmp_path / "film.mp4"), 0.8))
    assert "bytes that are no video yet: the index of an MP4 file is missing" in text
    assert "ended properly" in text


def test_what_is_missing_at_the_very_end_is_told(tmp_path: Path) -> None:
    path = cut(with_index_first(write_video(tmp_path / "film.mp4", 60, noise=True)), 0.97)
    times, source = read(path)
    assert 55 <= len(times) < 60
    assert "cut off at its end" in said(source)


def test_a_trimmed_video_is_whole(tmp_path: Path) -> None:
    path = with_edit_list(write_video(tmp_path / "film.mp4", 60), 0.0, 2.4)
    capture = cv2.VideoCapture(str(path))
    assert capture.get(cv2.CAP_PROP_FRAME_COUNT) == 60, "the header counts all samples"
    capture.release()
    times, source = read(path)
    assert len(times) == source.frame_count == 24
    assert said(source) == ""


def test_a_frame_count_in_the_header_proves_nothing(tmp_path: Path) -> None:
    path = write_video(tmp_path / "film.avi", 20)
    patched(path, b"vidsMJPG", 24, struct.pack("<I", 200))
    patched(path, b"avih", 20, struct.pack("<I", 200))
    times, source = read(path)
    assert len(times) == 20
    assert "the header announces 20.0 s, the file has 2.0 s of video" in said(source)


@pytest.mark.parametrize("size", [0, 2**32 - 1])
def test_an_avi_that_a_recorder_left_open_is_used(tmp_path: Path, size: int) -> None:
    path = patched(write_video(tmp_path / "film.avi"), b"RIFF", 0, struct.pack("<I", size))
    times, source = read(path)
    assert len(times) == 20
    assert "its size is left open" in said(source)


def test_a_webm_of_open_size_is_used(tmp_path: Path) -> None:
    path = write_video(tmp_path / "film.webm")
    patched(path, bytes.fromhex("18538067"), 0, b"\x01" + b"\xff" * 7)
    times, source = read(path)
    assert len(times) == 20
    assert "its size is left open" in said(source)


@pytest.mark.parametrize("fps", [None, 10.0, 40.0])
def test_a_stream_without_times_has_the_rate_that_is_given(
    tmp_path: Path, fps: float | None
) -> None:
    times, source = read(write_jpeg_stream(tmp_path / "raw.mjpeg"), SourceOptions(fps=fps))
    assert times == pytest.approx(np.arange(20) / (fps or 25.0), abs=1e-6)
    assert source.fps == (fps or 25.0)
    assert ("has no times: 25 images per second are assumed (--fps" in said(source)) == (
        fps is None
    )


@pytest.mark.parametrize(
    ("head", "kind"),
    [
        ("0000000167640016", "H.264"),
        ("00000109f0", "H.264"),
        ("0000000140010c01", "HEVC"),
        ("0000000146015000", "HEVC"),
        ("ffd8ffe0", "JPEG"),
        (b"--frame\r\nContent-Type: image/jpeg\r\n\r\n".hex(), "JPEG"),
    ],
)
def test_streams_without_times_are_known_by_their_first_bytes(
    tmp_path: Path, head: str, kind: str
) -> None:
    file = tmp_path / "raw"
    file.write_bytes(bytes.fromhex(head) + bytes(100))
    found = read_container(file)
    assert (found.codec, found.timed) == (kind, False)


@pytest.mark.parametrize("head", ["000001ba44000400", "000001b300f0", "000001b0f5", "4740001000"])
def test_streams_with_times_are_not_taken_for_them(tmp_path: Path, head: str) -> None:
    file = tmp_path / "raw"
    file.write_bytes(bytes.fromhex(head) + bytes(100))
    assert read_container(file).timed


@pytest.mark.parametrize("name", ["film.mp4", "film.avi", "film.webm"])
def test_a_rate_that_is_not_used_is_said(tmp_path: Path, name: str) -> None:
    times, source = read(write_video(tmp_path / name), SourceOptions(fps=50.0))
    assert times == pytest.approx(np.arange(20) / FPS, abs=0.002)
    assert "--fps 50 is not used: the file has times of its own, about 10 images" in said(source)


@pytest.mark.parametrize("offset_s", [SINCE_1904_S, 0])
def test_a_recording_starts_when_its_file_says(tmp_path: Path, offset_s: int) -> None:
    """From 1904, as the standard has it; some cameras count from 1970."""
    made_s = 1_716_537_600
    stamp = struct.pack(">I", made_s + offset_s)
    path = patched(write_video(tmp_path / "film.mp4"), b"mvhd", 4, stamp)
    with open_frame_source(str(path), SourceOptions(own_start=True)) as source:
        assert next(iter(source))[0] == made_s * 10**9
    assert "starts at 2024-05-24 08:00:00 UTC, as the file says" in said(source)
    assert read(path)[0][0] == 0.0, "only when it is asked for"


@pytest.mark.parametrize("made_s", [0, 3600, SINCE_1904_S + 3600])
def test_a_clock_that_was_not_set_says_no_time(tmp_path: Path, made_s: int) -> None:
    path = patched(write_video(tmp_path / "film.mp4"), b"mvhd", 4, struct.pack(">I", made_s))
    times, source = read(path, SourceOptions(own_start=True))
    assert times[0] == 0.0
    assert "doesn't say when it was made" in said(source)


@pytest.mark.parametrize(
    ("tag", "words"),
    [
        (b"av01", "AV1 video"),
        (b"vvc1", "VVC video"),
        (b"encv", "encrypted video"),
        (b"xyz1", "xyz1 video"),
    ],
)
def test_a_codec_that_ffmpeg_lacks_is_named(tmp_path: Path, tag: bytes, words: str) -> None:
    path = patched(write_video(tmp_path / "film.mp4"), b"stsd", 12, tag)
    patched(path, b"esds", -4, b"free")  # which would tell the true one
    text = refusal(path)
    assert words in text
    assert "ffmpeg -i IN -c:v libx264 OUT.mp4" in text


def test_sound_alone_is_named(tmp_path: Path) -> None:
    path = patched(write_video(tmp_path / "film.mp4"), b"hdlr", 8, b"soun")
    assert read_container(path).video is False


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "an empty file (0 bytes)"),
        (b"ID3\x04" + bytes(500), "sound without images"),
        (b"RIFF\x24\x00\x00\x00WAVEfmt " + bytes(500), "sound without images"),
        (b"<!DOCTYPE html><html>login</html>", "a web page"),
        (b"\xef\xbb\xbf  <html>login</html>", "a web page"),
        (b"PK\x03\x04" + bytes(500), "a ZIP archive"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0", "a Git LFS pointer"),
        (b"#EXTM3U\n#EXTINF:1,\na.ts\n", "a playlist"),
        (b"\0" * 5000, "5000 bytes that are no video"),
        (b"\0\0\0\x18ftypisom" + bytes(4), "index of an MP4 file is missing"),
        (b"\x1a\x45\xdf\xa3" + b"\xff" * 60, "bytes that are no video"),
        (b"RIFF\xff\xff\xff\xffAVI LIST", "bytes that are no video"),
    ],
)
def test_what_is_no_video_is_named(tmp_path: Path, content: bytes, words: str) -> None:
    file = tmp_path / "film.mp4"
    file.write_bytes(content)
    assert words in refusal(file)


def test_damage_in_the_middle_loses_no_more_than_it_must(tmp_path: Path) -> None:
    path = write_video(tmp_path / "film.avi", 60, noise=True)
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 3000] = bytes(3000)
    path.write_bytes(bytes(data))
    assert len(read(path)[0]) >= 58


def test_a_recording_whose_second_part_was_never_written_is_refused_at_its_end(
    tmp_path: Path,
) -> None:
    """As a card that was full size from the start, when the power fails: zeros follow."""
    path = write_video(tmp_path / "film.mp4", 60, noise=True)
    data = bytearray(path.read_bytes())
    start, end = data.index(b"mdat"), data.index(b"moov")
    data[start + (end - start) // 5 : end - 4] = bytes(end - 4 - start - (end - start) // 5)
    path.write_bytes(bytes(data))
    times: list[int] = []
    with open_frame_source(str(path)) as source:
        stamps = (stamp for stamp, _ in source)
        with pytest.raises(FrameSourceError, match=r"breaks off after [01]\.\d of 6\.0 s"):
            times.extend(stamps)
    assert len(times) >= 3, "what is there comes first"


def test_an_image_turned_by_the_container_is_told(tmp_path: Path) -> None:
    matrix = struct.pack(">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, 0, 0, 1 << 30)
    path = patched(write_video(tmp_path / "film.mp4"), b"tkhd", 40, matrix)
    with open_frame_source(str(path)) as source:
        _, image = next(iter(source))
    assert image.shape[:2] == (SIZE[0], SIZE[1])
    assert "images are turned by" in said(source)


def exif_turned(path: Path, orientation: int) -> None:
    """A JPEG image with an EXIF entry (Exif 2.32, tag 0x0112)."""
    _, jpeg = cv2.imencode(".jpg", np.arange(120 * 160, dtype=np.uint8).reshape(120, 160))
    tiff = b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01" + struct.pack(">HH", orientation, 0)
    block = b"Exif\0\0" + tiff + bytes(4)
    data = jpeg.tobytes()
    path.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(block) + 2) + block + data[2:])


@pytest.mark.parametrize(("orientation", "size"), [(1, SIZE), (6, SIZE[::-1]), (3, SIZE)])
def test_images_are_turned_as_viewers_show_them(
    tmp_path: Path, orientation: int, size: tuple[int, int]
) -> None:
    exif_turned(tmp_path / "1.jpg", orientation)
    exif_turned(tmp_path / "2.jpg", orientation)
    with open_frame_source(str(tmp_path), SourceOptions(fps=1.0)) as source:
        images = [image for _, image in source]
    assert {image.shape[1::-1] for image in images} == {size}
    assert ("images are turned" in said(source)) == (orientation != 1)


def test_files_that_systems_leave_are_no_images(tmp_path: Path) -> None:
    for k in range(2):
        assert cv2.imwrite(str(tmp_path / f"{k}.jpg"), grey_image(90, SIZE))
    for name in ("._0.jpg", ".DS_Store", "Thumbs.db", "desktop.ini", ".trash.png"):
        (tmp_path / name).write_bytes(b"no image")
    (tmp_path / "2.jpg").mkdir()
    times, source = read(tmp_path, SourceOptions(fps=1.0))
    assert (times, said(source)) == ([0.0, 1.0], "")


def test_a_folder_of_videos_says_what_is_in_it(tmp_path: Path) -> None:
    write_video(tmp_path / "1.mp4")
    (tmp_path / ".hidden.jpg").write_bytes(b"")
    assert "no image, but 1 other entries (1.mp4, …)" in refusal(tmp_path)


def test_a_single_image_needs_no_rate(tmp_path: Path) -> None:
    assert cv2.imwrite(str(tmp_path / "photo.jpg"), grey_image(90, SIZE))
    assert read(tmp_path / "photo.jpg")[0] == [0.0]


def test_images_that_cant_be_used_are_left_out_and_counted(tmp_path: Path) -> None:
    for k in range(6):
        size = (80, 60) if k == 4 else SIZE
        assert cv2.imwrite(str(tmp_path / f"{k}.png"), grey_image(90, size))
    (tmp_path / "1.png").write_bytes(b"")
    (tmp_path / "2.png").write_bytes(b"half an ima")
    left_out = LeftOut()
    times, source = read(tmp_path, SourceOptions(fps=1.0, on_bad_frame=left_out))
    assert times == [0.0, 3.0, 5.0]
    left_out.report_to(source.remarks, len(times))
    text = said(source)
    assert f"2 of 6 images left out: not a complete one (first: {tmp_path / '1.png'}" in text
    assert "1 of 6 images left out: not 160x120 as before" in text
    assert "4.png: a frame of 80x60 pixels" in text


def test_times_that_a_container_lacks_follow_from_those_before(tmp_path: Path) -> None:
    """Some writers give the last images the time 0."""
    path = write_video(tmp_path / "film.webm", 20)
    times, _ = read(path)
    assert np.all(np.diff(times) > 0.0)
    assert times == pytest.approx(np.arange(20) / FPS, abs=0.002)
