"""A fleet runs once in its folder."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from geoorbit_ros.cli.main import main
from geoorbit_ros.core.errors import DISK_FAULTS, disk_fault
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


def test_an_output_folder_that_cant_be_made_is_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    assert main(["up", "demo", "--out", str(tmp_path / "file" / "out")]) == 2
    said = capsys.readouterr().err
    assert "found Not a directory, expected a place that can be written to" in said
    assert said.count("\n") == 1


@pytest.mark.parametrize("number", sorted(DISK_FAULTS))
def test_a_fault_of_the_disk_is_one_sentence_wherever_it_is_met(number: int) -> None:
    fault = disk_fault(OSError(number, os.strerror(number), "/data/north.db"))
    assert str(fault).startswith(f"/data/north.db: found {os.strerror(number)}, expected a place")
    assert disk_fault(OSError(errno.EBADF, "a defect")) is None
