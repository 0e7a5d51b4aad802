"""`geoorbit calibrate` refuses outputs before any work, and never writes over an input."""

from __future__ import annotations

from pathlib import Path

import pytest

from geoorbit_ros.cli.main import main

TRACKS = "id,time,frame_num,class,conf,x,y,w,h\n1,0.0,0,2,0.9,600,400,50,40\n"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--out", "tracks.csv"], "an input"),
        (["--out", "points.csv", "--points", "points.csv"], "an input"),
        (["--out", "a.png", "--picture", "a.png"], "the picture"),
        (["--out", "out.csv", "--picture", "image.png", "--image", "image.png"], "an input"),
        (["--out", "folder"], "a folder"),
        (["--out", "out.csv", "--near", "-89.40,43.07"], "option --near"),
        (["--out", "/proc/out.csv"], "a place that can be written to"),
        (["--out", "out.csv"], "moving vehicles"),
    ],
)
def test_nothing_is_written_and_one_sentence_says_why(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    options: list[str],
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    for name in ("tracks.csv", "points.csv", "image.png"):
        (tmp_path / name).write_text(TRACKS)
    before = sorted(tmp_path.iterdir())
    assert main(["calibrate", "--tracks", "tracks.csv", *options]) == 2
    assert words in " ".join(capsys.readouterr().err.split())
    assert sorted(tmp_path.iterdir()) == before
    assert all(file.read_text() == TRACKS for file in before if file.is_file())
