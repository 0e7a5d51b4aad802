"""A state is never a reason not to start: two generations, and a broken one is set aside."""

from __future__ import annotations

import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from geoorbit_ros.core.array_file import MAX_ARRAY_BYTES, read_arrays
from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.state_file import NewerStateError, StateFile


def number(path: Path) -> int:
    return int(path.read_text())


def state_in(folder: Path) -> StateFile:
    return StateFile(folder / "state" / "n.txt", "a number")


def test_the_newest_whole_generation_counts_and_a_broken_one_is_set_aside(tmp_path: Path) -> None:
    state = state_in(tmp_path)
    assert state.read(number) is None
    for value in (1, 2, 3):
        state.write(b"%d" % value)
        assert state_in(tmp_path).read(number) == value
    assert state.path.stat().st_mode & 0o77 == 0
    state.path.write_bytes(b"\x80 rubbish")
    assert state.read(number) == 2
    assert state.fell_back
    assert state.path.with_name("n.txt.damaged").read_bytes() == b"\x80 rubbish"
    assert "n.txt: found damage" in state.told[0]
    state.write(b"9")
    state.path.write_bytes(b"")
    state.previous.write_bytes(b"")
    assert state.read(number) is None
    state.write(b"4")
    assert state.read(number) == 4
    assert not state.fell_back


def test_killed_between_two_renames_nothing_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Killed(BaseException):
        pass

    for renames in (0, 1):
        state, left = state_in(tmp_path), [renames]
        state.write(b"1")
        state.write(b"2")
        replace = Path.replace

        def killed(path: Path, target: Path, left: list[int] = left, real: Any = replace) -> Path:
            if not left[0]:
                raise Killed
            left[0] -= 1
            found: Path = real(path, target)
            return found

        with monkeypatch.context() as patched:
            patched.setattr(Path, "replace", killed)
            with pytest.raises(Killed):
                state.write(b"3")
        assert state_in(tmp_path).read(number) == 2
        state.write(b"4")
        assert state_in(tmp_path).read(number) == 4


def test_who_deletes_the_file_begins_anew(tmp_path: Path) -> None:
    state = state_in(tmp_path)
    state.write(b"1")
    state.write(b"2")
    state.path.unlink()
    assert state.read(number) is None
    assert not state.told


@pytest.mark.parametrize("call", ["open", "fsync"])
def test_a_full_disk_leaves_both_generations(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    state = state_in(tmp_path)
    state.write(b"1")
    state.write(b"2")

    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(os, call, full)
        with pytest.raises(InputFileError, match=r"n\.txt: found No space left on device"):
            state.write(b"3")
    assert sorted(path.name for path in state.path.parent.iterdir()) == ["n.txt", "n.txt.previous"]
    assert (number(state.path), number(state.previous)) == (2, 1)


def test_a_newer_version_is_refused_and_left_alone(tmp_path: Path) -> None:
    state = state_in(tmp_path)
    state.write(b"9")

    def newer(path: Path) -> int:
        raise NewerStateError(str(path), "format 9", "format 1")

    with pytest.raises(NewerStateError):
        state.read(newer)
    assert state.read(number) == 9


@pytest.mark.parametrize(
    "content", [b"", b"lanes", b"PK\x03\x04 half a zip", b"\x93NUMPY", b"\x80"]
)
def test_what_is_no_file_of_arrays_is_told_without_advice_for_programmers(
    tmp_path: Path, content: bytes
) -> None:
    file = tmp_path / "a.npz"
    file.write_bytes(content)
    with pytest.raises(InputFileError, match=r"a\.npz: found damage.*expected a model") as caught:
        read_arrays(file, "a model")
    assert "pickle" not in str(caught.value)


def test_objects_and_small_files_that_stand_for_much_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "objects.npz", a=np.array([{}], dtype=object), allow_pickle=True)
    with pytest.raises(InputFileError, match="expected a model"):
        read_arrays(tmp_path / "objects.npz", "a model")
    with (
        zipfile.ZipFile(tmp_path / "big.npz", "w", zipfile.ZIP_DEFLATED) as packed,
        packed.open("a.npy", "w", force_zip64=True) as stream,
    ):
        block = bytes(1 << 24)
        for _ in range(MAX_ARRAY_BYTES // len(block) + 1):
            stream.write(block)
    with pytest.raises(InputFileError, match="at most"):
        read_arrays(tmp_path / "big.npz", "a model")
    with pytest.raises(FileNotFoundError):
        read_arrays(tmp_path / "none.npz", "a model")
