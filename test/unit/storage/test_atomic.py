from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from geoorbit_ros.core.errors import InputFileError, disk_fault
from geoorbit_ros.storage.atomic import atomic_output


def write_half(path: Path, *, folder: bool = False, overwrite: bool = False) -> None:
    with atomic_output(path, overwrite=overwrite) as temporary:
        if folder:
            temporary.mkdir()
            (temporary / "part").write_text("new")
        else:
            temporary.write_text("new")
        raise RuntimeError


def meet_a_full_disk(path: Path, named: str | None) -> None:
    with atomic_output(path) as temporary:
        where = [] if named is None else [str(temporary / named)]
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), *where)


@pytest.mark.parametrize("folder", [False, True])
def test_failure_leaves_no_trace(tmp_path: Path, folder: bool) -> None:
    with pytest.raises(RuntimeError):
        write_half(tmp_path / "made" / "deep" / "out", folder=folder)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("named", "inside"), [(None, ""), ("", ""), ("road.png", "/road.png"), ("/elsewhere", None)]
)
def test_a_fault_of_the_disk_names_the_file_that_was_asked_for(
    tmp_path: Path, named: str | None, inside: str | None
) -> None:
    with pytest.raises(OSError, match="No space left") as raised:
        meet_a_full_disk(tmp_path / "out", named)
    expected = "/elsewhere" if inside is None else f"{tmp_path}/out{inside}"
    fault = disk_fault(raised.value)
    assert fault is not None
    assert str(fault).startswith(f"{expected}: found No space left")


def test_failure_keeps_what_was_there(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("old")
    with pytest.raises(RuntimeError):
        write_half(tmp_path / "out")
    assert (tmp_path / "out").read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_nothing_is_visible_before_the_end(tmp_path: Path) -> None:
    out = tmp_path / "made" / "out.csv"
    with atomic_output(out) as temporary:
        temporary.write_text("new")
        assert not out.exists()
        assert temporary.name == out.name
    assert out.read_text() == "new"
    assert [path.name for path in out.parent.iterdir()] == ["out.csv"]


def test_a_file_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("old")
    with atomic_output(tmp_path / "out") as temporary:
        temporary.write_text("new")
    assert (tmp_path / "out").read_text() == "new"


def test_a_folder_with_content_is_refused_before_any_work(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "precious").write_text("old")
    with (
        pytest.raises(InputFileError, match="folder with content"),
        atomic_output(tmp_path / "out"),
    ):
        pytest.fail("the block must not run")
    assert (tmp_path / "out" / "precious").read_text() == "old"


def test_on_demand_a_folder_is_written_into_and_nothing_of_another_name_is_lost(
    tmp_path: Path,
) -> None:
    out = tmp_path / "out"
    (out / "sub").mkdir(parents=True)
    for name in ("a recording", "part", "sub/old"):
        (out / name).write_text("old")
    with pytest.raises(RuntimeError):
        write_half(out, folder=True, overwrite=True)
    assert (out / "part").read_text() == "old"
    with atomic_output(out, overwrite=True) as temporary:
        (temporary / "sub").mkdir(parents=True)
        for name in ("part", "sub/new"):
            (temporary / name).write_text("new")
    assert (out / "a recording").read_text() == "old"
    assert (out / "part").read_text() == "new"
    assert [path.name for path in (out / "sub").iterdir()] == ["new"]
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_an_empty_folder_gives_way(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    with atomic_output(tmp_path / "out") as temporary:
        temporary.write_text("a file")
    assert (tmp_path / "out").read_text() == "a file"


def test_a_file_where_a_folder_must_be_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputFileError, match="file"), atomic_output(tmp_path / "file" / "out"):
        pytest.fail("the block must not run")


def test_a_pipe_gets_the_result_and_stays_a_pipe(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    with atomic_output(pipe) as path:
        path.write_text("whole")
        assert path.parent != tmp_path
    assert os.read(reader, 100) == b"whole"
    assert pipe.is_fifo()
    os.close(reader)


def test_a_device_takes_no_folder() -> None:
    with (
        pytest.raises(InputFileError, match="a device or a pipe"),
        atomic_output(Path(os.devnull)) as path,
    ):
        path.mkdir()
    assert Path(os.devnull).is_char_device()
