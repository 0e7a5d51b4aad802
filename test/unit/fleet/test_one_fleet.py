"""A fleet runs once in its folder."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from geoorbit_ros.cli.main import main
from geoorbit_ros.storage.ownership import Ownership


def test_a_second_up_says_who_is_there_and_ends(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    with Ownership(out / ".up.lock", str(out)):
        assert main(["up", "demo", "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert f"{out}: found in use by process {os.getpid()} since " in said
    assert said.count("\n") == 1
    assert not (out / "logs").exists()
