"""`geoorbit detect`: what is said about its images, and what is kept when it ends early."""

import re
from pathlib import Path

import cv2
import pytest
from made_videos import SIZE, cut, with_index_first, write_jpeg_stream, write_video
from mjpeg_server import MjpegServer, grey_image

from geoorbit_ros.cli.main import EXIT_BAD_INPUT, main
from geoorbit_ros.cli.signals import EXIT_INTERRUPTED

PLUGIN = '''
import os, signal
import numpy as np
from geoorbit_ros.core.tables import DETECTION_DTYPE

class Finder:
    """One box per image, further right in each; at image {at} it does `{what}`."""
    name = "finder"
    seen = 0
    def __init__(self):
        pass
    def warm_up(self, images):
        pass
    def detect(self, stamp_ns, image):
        type(self).seen += 1
        if stamp_ns == 1_000_000_000 + {at} * 100_000_000:
            {what}
        rows = np.zeros(1, DETECTION_DTYPE)
        rows["x"] = 20 + stamp_ns % 10**9 / 10**8
        rows["y"], rows["width"], rows["height"], rows["score"], rows["class_id"] = 50, 8, 8, .9, 2
        return rows
'''
INTERRUPT = "os.kill(os.getpid(), signal.SIGINT)"


def finder(folder: Path, at: int, what: str) -> str:
    file = folder / "finder.py"
    file.write_text(PLUGIN.format(at=at, what=what))
    return f"{file}:Finder"


def lines(path: Path) -> list[str]:
    return path.read_text().splitlines()


def numbers(path: Path) -> list[int]:
    return [int(line.partition(",")[0]) for line in lines(path)]


@pytest.fixture
def film(tmp_path: Path) -> Path:
    return write_video(tmp_path / "film.mp4", 20)


@pytest.mark.parametrize(
    ("what", "status"),
    [(INTERRUPT, EXIT_INTERRUPTED), ("raise ValueError('no memory')", EXIT_BAD_INPUT)],
)
def test_what_was_found_before_an_early_end_is_kept_and_a_run_goes_on_from_there(
    tmp_path: Path, film: Path, what: str, status: int, capsys: pytest.CaptureFixture[str]
) -> None:
    out, whole = tmp_path / "d.txt", tmp_path / "whole.txt"
    model = finder(tmp_path, 7, "pass")
    assert main(["detect", str(film), "--model", model, "--out", str(whole)]) == 0
    finder(tmp_path, 7, what)
    assert main(["detect", str(film), "--model", model, "--out", str(out)]) == status
    kept = len(lines(out))
    assert kept in (7, 8), "the image at hand may be finished"
    assert lines(out) == lines(whole)[:kept]
    error = capsys.readouterr().err
    assert f"Ended early, after {kept} images. What was found in them is in {out}." in error
    assert f"--resume goes on from there ({out}.resume)" in error
    finder(tmp_path, 7, "pass")
    assert main(["detect", str(film), "--model", model, "--out", str(out), "--resume"]) == 0
    assert lines(out) == lines(whole)
    assert not Path(f"{out}.resume").exists()


def test_a_run_goes_on_with_the_same_images_and_options_only(
    tmp_path: Path, film: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, model = tmp_path / "d.txt", finder(tmp_path, 7, INTERRUPT)
    words = ["detect", str(film), "--model", model, "--out", str(out)]
    assert main(words) == EXIT_INTERRUPTED
    for option, value, named in (("--min-score", "0.5", "min score"), ("--fps", "9", "fps")):
        assert main([*words, "--resume", option, value]) == EXIT_BAD_INPUT
        assert f"found {named} {value}" in capsys.readouterr().err
    with film.open("ab") as file:
        file.write(b"more")
    assert main([*words, "--resume"]) == EXIT_BAD_INPUT
    assert re.search(r"size \d+ bytes, which was \d+ bytes", capsys.readouterr().err)


def test_what_cannot_be_resumed_is_one_sentence(
    tmp_path: Path, film: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "d.txt"
    assert main(["detect", str(film), "--out", str(out), "--resume"]) == EXIT_BAD_INPUT
    assert "found no such run" in capsys.readouterr().err
    Path(f"{out}.resume").write_bytes(b"PK\x03\x04 half of it")
    assert main(["detect", str(film), "--out", str(out), "--resume"]) == EXIT_BAD_INPUT
    assert "run again without --resume" in capsys.readouterr().err
    words = ["detect", "http://127.0.0.1:9/s", "--duration", "1", "--out", str(out), "--resume"]
    assert main(words) == EXIT_BAD_INPUT
    assert "found a stream, expected a recording" in capsys.readouterr().err


def test_a_stream_keeps_what_it_gave_before_ctrl_c(tmp_path: Path) -> None:
    out = tmp_path / "d.txt"
    model = finder(tmp_path, 0, "pass")
    file = Path(model.partition(":")[0])
    third = f"if self.seen == 3: {INTERRUPT}"
    file.write_text(file.read_text().replace("rows = np", f"{third}\n        rows = np", 1))
    with MjpegServer([], [grey_image(90)] * 6) as server:
        words = ["detect", server.address, "--duration", "60", "--model", model, "--out", str(out)]
        assert main(words) == EXIT_INTERRUPTED
    assert len(lines(out)) >= 3
    assert not Path(f"{out}.resume").exists()


def test_a_rate_is_used_for_a_stream_without_times(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    film, out = write_jpeg_stream(tmp_path / "raw.mjpeg"), tmp_path / "d.txt"
    model = finder(tmp_path, 99, "pass")
    words = ["detect", str(film), "--model", model, "--out", str(out), "--duration", "1"]
    assert main([*words, "--fps", "10"]) == 0
    assert numbers(out) == list(range(1, 11))
    assert "assumed" not in capsys.readouterr().out
    assert main(words) == 0
    assert len(numbers(out)) == 20
    assert "25 images per second are assumed" in " ".join(capsys.readouterr().out.split())


def test_images_left_out_keep_their_numbers_and_are_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, out = tmp_path / "images", tmp_path / "d.txt"
    folder.mkdir()
    for k in range(8):
        assert cv2.imwrite(str(folder / f"{k}.png"), grey_image(90, SIZE))
    (folder / "2.png").write_bytes(b"")
    (folder / "5.png").write_bytes(b"no image")
    model = finder(tmp_path, 99, "pass")
    words = ["detect", str(folder), "--fps", "10", "--model", model, "--out", str(out)]
    assert main(words) == 0
    assert numbers(out) == [1, 2, 4, 5, 7, 8]
    shown = " ".join(capsys.readouterr().out.split())
    assert "2 of 8 images left out: not a complete one (first:" in shown
    assert main([*words, "--strict"]) == EXIT_BAD_INPUT
    assert "2.png: found no readable image" in capsys.readouterr().err
    for k in range(3, 8):
        (folder / f"{k}.png").write_bytes(b"")
    out.unlink()
    assert main(words) == EXIT_BAD_INPUT
    assert "6 of 8 images left out" in capsys.readouterr().err
    assert not out.exists()


def test_a_cut_video_is_refused_unless_a_duration_says_how_much_is_enough(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    film = cut(with_index_first(write_video(tmp_path / "film.mp4", 60, noise=True)), 0.5)
    out, model = tmp_path / "d.txt", finder(tmp_path, 99, "pass")
    words = ["detect", str(film), "--model", model, "--out", str(out)]
    assert main(words) == EXIT_BAD_INPUT
    assert "breaks off after" in capsys.readouterr().err
    assert not out.exists()
    assert main([*words, "--duration", "60"]) == 0
    assert len(lines(out)) > 10
    assert "what is there is used" in capsys.readouterr().out


def test_varying_times_are_told_where_they_get_lost(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    for k in range(8):
        name = f"{1_700_000_000 + k * k}.png"
        assert cv2.imwrite(str(folder / name), grey_image(90, SIZE))
    words = ["detect", str(folder), "--model", finder(tmp_path, 99, "pass")]
    assert main([*words, "--out", str(tmp_path / "d.txt")]) == 0
    assert "their numbers don't tell their times" in " ".join(capsys.readouterr().out.split())


def test_fewer_images_are_looked_at_evenly_and_keep_their_numbers(
    tmp_path: Path, film: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """20 images of a film at 10 per second: every third at 3.33 per second, all of them at 50."""
    words = ["detect", str(film), "--model", finder(tmp_path, 99, "pass"), "--out"]
    out, whole, all_of_it = (tmp_path / name for name in ("some.txt", "whole.txt", "all.txt"))
    assert main([*words, str(whole)]) == 0
    assert main([*words, str(all_of_it), "--max-fps", "50"]) == 0
    assert lines(all_of_it) == lines(whole)
    capsys.readouterr()
    assert main([*words, str(out), "--max-fps", "3.33"]) == 0
    assert numbers(out) == [1, 4, 7, 10, 13, 16, 19]
    assert "7 boxes in 7 of 20 images" in " ".join(capsys.readouterr().out.split())
    assert set(lines(out)) <= set(lines(whole))
