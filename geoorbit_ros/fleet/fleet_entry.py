"""Adds a camera to a fleet file without touching what people wrote in it."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import yaml

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.fleet.fleet_file import Fleet, load_fleet
from geoorbit_ros.storage.atomic import atomic_output


def add_camera(file: Path, entry: Mapping[str, object], fleet_name: str = "fleet") -> Fleet:
    """Add an entry after the last camera of a fleet file, or write a new file.

    Comments and order stay. The result is read back before it replaces the file.

    Args:
        file: The fleet file.
        entry: The camera's keys and values; paths relative to the file.
        fleet_name: Of a new file.

    Raises:
        InputFileError: The file is no fleet file, already has this camera, or would be wrong with
            it; then it is left as it was.
    """
    check_new_camera(file, str(entry["id"]))
    if file.exists():
        text = _inserted(file.read_text(encoding="utf-8").rstrip("\n") + "\n", entry)
    else:
        text = f"name: {fleet_name}\ncameras:\n{_item(entry, '  ')}"
    with atomic_output(file) as path:
        path.write_text(text, encoding="utf-8")
        return load_fleet(path)[0]


def check_new_camera(file: Path, camera_id: str) -> None:
    """Refuse a camera that a fleet file has already; a file that isn't there has none.

    Raises:
        InputFileError: It has, or is no fleet file.
    """
    if file.exists() and camera_id in [camera.id for camera in load_fleet(file)[0].cameras]:
        raise InputFileError(str(file), f"camera '{camera_id}' is there already", "another id")


def relative(path: Path, file: Path) -> str:
    """A path as a fleet file names it."""
    return os.path.relpath(path.absolute(), file.absolute().parent)


def _inserted(text: str, entry: Mapping[str, object]) -> str:
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    assert isinstance(root, yaml.MappingNode)  # it was read as a fleet
    cameras = next(value for key, value in root.value if key.value == "cameras")
    lines = text.splitlines(keepends=True)
    if cameras.flow_style:
        raise InputFileError(
            "fleet file, key 'cameras'", "a list in brackets", "one camera per '-'"
        )
    last = cameras.value[-1]
    end = last.end_mark.line + int(last.flow_style)
    while end > last.start_mark.line and not lines[end - 1].strip(" \n").partition("#")[0].strip():
        end -= 1  # comments and empty lines that follow belong to what comes next
    indent = " " * cameras.start_mark.column
    return "".join([*lines[:end], _item(entry, indent), *lines[end:]])


def _item(entry: Mapping[str, object], indent: str) -> str:
    body = yaml.safe_dump(dict(entry), sort_keys=False, allow_unicode=True, default_flow_style=None)
    first, *rest = body.splitlines()
    return "".join([f"{indent}- {first}\n", *(f"{indent}  {line}\n" for line in rest)])
