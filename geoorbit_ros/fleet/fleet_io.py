"""Fleet files are read, and cameras go into them and out of them; comments and order stay."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path

import yaml

from geoorbit_ros.core.addresses import masked_text
from geoorbit_ros.core.errors import InputFileError, ParameterError
from geoorbit_ros.core.input_report import InputReport, Treatment
from geoorbit_ros.core.resources import file_or_shipped
from geoorbit_ros.fleet.fleet_file import (
    IDENTIFIER,
    RESERVED_NAMES,
    SERVICE_MODELS,
    Camera,
    Fleet,
    Position,
)
from geoorbit_ros.parameters import nearest
from geoorbit_ros.storage.atomic import atomic_output
from geoorbit_ros.storage.yaml_file import YamlText, read_text, read_yaml

FOLDER = "params/fleets"
_SWITCH: dict[str, dict[str, bool]] = {
    **{word: {} for word in ("true", "yes", "on")},
    **{word: {"enabled": False} for word in ("false", "no", "off")},
}
"""What a service that is only switched on or off means."""


def load_fleet(path: str | Path, report: InputReport | None = None) -> tuple[Fleet, Path]:
    """Read a fleet file, or a shipped fleet by its bare name.

    Args:
        path: The file or the name.
        report: Takes cameras and services that can't be used, and leaves them out; None: the first
            refuses the file.

    Returns:
        The fleet, and the file it was read from: its relative paths start there.

    Raises:
        InputFileError: No such file, or a value that a fleet can't have, with its line and key.
    """
    file = file_or_shipped(path, FOLDER, "fleet")
    if report is None:
        return read_yaml(file, Fleet, "fleet"), file
    return _usable(read_text(file, "fleet", report), report), file


def _usable(text: YamlText, report: InputReport) -> Fleet:
    """The fleet without what can't be used of it.

    Raises:
        InputFileError: No camera is left, or its cameras can't be told.
    """
    content, place = dict(text.content), Path(text.file)
    for key in [key for key in content if key not in Fleet.model_fields]:
        expected = nearest(key, Fleet.model_fields)
        report.note(
            Treatment.LEFT_OUT, f"{key} is left out: found an unknown key, expected {expected}"
        )
        del content[key]
    name = str(content.get("name") or "")
    if not re.match(IDENTIFIER, name):
        content["name"] = fleet_name(Path(name) if name else place)
        shown = f"the fleet's name '{masked_text(name)}' becomes '{content['name']}'"
        report.note(Treatment.REPAIRED, shown)
    entries = content.get("cameras")
    if isinstance(entries, dict) and "source" in entries:
        entries = [entries]
    if isinstance(entries, dict):
        entries = [{"id": key, **(value or {})} for key, value in entries.items()]
        report.note(Treatment.REPAIRED, "cameras are read as a list, their keys as ids")
    if isinstance(entries, list):
        content["cameras"] = _usable_cameras(text, entries, report)
    services = [key for key in content if key in SERVICE_MODELS and content[key] is not None]
    for key in services:
        content[key] = _SWITCH.get(str(content[key]).lower(), content[key])
        try:
            content[key] = text.checked(SERVICE_MODELS[key], content[key], report, (key,))
        except InputFileError as error:
            report.note(Treatment.LEFT_OUT, f"{key} is left out: {error}")
            del content[key]
    if content.get("carla") is not None and content.get("twin") is None:
        report.note(Treatment.LEFT_OUT, "carla is left out, as there is no twin")
        del content["carla"]
    return text.checked(Fleet, content, report)


def _usable_cameras(text: YamlText, entries: list[object], report: InputReport) -> list[Camera]:
    """The cameras of a file that can be used."""
    cameras: dict[str, Camera] = {}
    report.total = len(entries)
    for k, entry in enumerate(entries):
        name = entry.get("id", k + 1) if isinstance(entry, dict) else k + 1
        try:
            camera = text.checked(Camera, entry, report, ("cameras", k))
            if camera.id in cameras:
                key = ("cameras", k, "id")
                raise text.refusal(key, f"'{camera.id}' again", "another id for each camera")
            if camera.id in RESERVED_NAMES:
                key = ("cameras", k, "id")
                raise text.refusal(key, f"'{camera.id}'", "a name that no service has")
            cameras[camera.id] = camera
        except InputFileError as error:
            report.add(Treatment.LEFT_OUT, 1, f"{name}: {error}")
    if entries and not cameras:
        first = next(r.text for r in report.remarks if r.count)
        raise InputFileError(text.file, f"no camera that can be used ({first})", "one or more")
    return list(cameras.values())


def fleet_name(file: Path) -> str:
    """A file's name as a name that ROS 2 takes."""
    name = re.sub(r"\W", "_", file.stem, flags=re.ASCII)
    return name if re.match(IDENTIFIER, name) else f"fleet_{name}"


FOUND_KEYS = (
    "id", "source", "calibration", "camera_info", "image_size", "datum", "model", "password_file",
    "password_variable",
)  # fmt: skip
"""What `add_camera` is told of a camera; the other keys are set by hand."""


def add_camera(file: Path, entry: Mapping[str, object], *, replace: bool = False) -> Fleet:
    """Add an entry after the last camera of a fleet file, or write a new file.

    Comments and order of the file stay, and so do the keys of a replaced camera that are set by
    hand. The result is read back before it replaces the file. A new fleet is named after its file.

    Args:
        file: The fleet file.
        entry: The camera's keys and values; paths relative to the file.
        replace: Whether it takes the place of a camera with the same id, where there is one.

    Raises:
        InputFileError: The file is no fleet file, already has this camera, or would be wrong with
            it; then it is left as it was.
    """
    camera_id = str(entry["id"])
    check_new_camera(file, camera_id, replace=replace)
    if file.exists():
        text = _text_of(file)
        known = camera_id in [camera.id for camera in load_fleet(file)[0].cameras]
        text = _exchanged(file, text, camera_id, entry) if known else _inserted(file, text, entry)
    else:
        text = f"name: {fleet_name(file)}\ncameras:\n{_item(entry, '  ')}"
    return _written(file, text)


def remove_camera(file: Path, camera_id: str) -> Fleet:
    """Take a camera out of a fleet file; comments and order of the rest stay.

    Raises:
        InputFileError: The file is no fleet file, has no such camera, or none but this one; then it
            is left as it was.
    """
    cameras = [camera.id for camera in load_fleet(file)[0].cameras]
    if camera_id not in cameras:
        raise InputFileError(str(file), f"no camera '{camera_id}'", f"one of {', '.join(cameras)}")
    if len(cameras) == 1:
        expected = "another camera, which a fleet needs; delete the file to end the fleet"
        raise InputFileError(str(file), f"only camera '{camera_id}'", expected)
    text = _exchanged(file, _text_of(file), camera_id, None)
    return _written(file, text)


def _text_of(file: Path) -> str:
    """A fleet file's text, whatever its encoding and line ends, with a line end at its end."""
    text = read_text(file, "fleet", InputReport(str(file), "cameras")).text
    return text.replace("\r\n", "\n").rstrip("\n") + "\n"


def _written(file: Path, text: str) -> Fleet:
    """Write a fleet file, with the line ends that it has; the fleet as it is read again.

    Raises:
        InputFileError: The text is no fleet file; then the file is left as it was.
    """
    windows = file.exists() and "\r\n" in read_text(file, "fleet", InputReport("", "")).text
    with atomic_output(file) as path:
        path.write_bytes((text.replace("\n", "\r\n") if windows else text).encode())
        try:
            return load_fleet(path)[0]
        except InputFileError as error:
            place = error.place.replace(str(path), str(file))
            found = f"{error.found} in what it would become (a part of it may use this camera's)"
            raise InputFileError(place, found, error.expected) from None


def check_new_camera(file: Path, camera_id: str, *, replace: bool = False) -> None:
    """Refuse a camera whose id can't be, or that a fleet file has already, unless `replace`.

    Raises:
        ParameterError: Such an id.
        InputFileError: The file has it, or is no fleet file; one that isn't there has none.
    """
    if not re.match(IDENTIFIER, camera_id):
        expected = "a letter, then letters, digits or underscores, as in ROS 2 names"
        raise ParameterError("option --camera-id", repr(camera_id), expected)
    if not file.exists():
        return
    known = camera_id in [camera.id for camera in load_fleet(file)[0].cameras]
    if known and not replace:
        expected = "another id, or --replace"
        raise InputFileError(str(file), f"camera '{camera_id}' is there already", expected)


def datum_of(file: Path, camera_id: str) -> Position | None:
    """Origin of a camera's map as a fleet file says; None without file, camera or such a key."""
    cameras = load_fleet(file)[0].cameras if file.exists() else ()
    return next((c.datum for c in cameras if c.id == camera_id), None)


def relative(path: Path, file: Path) -> str:
    """A path as a fleet file names it."""
    return os.path.relpath(path.absolute(), file.absolute().parent)


def _inserted(file: Path, text: str, entry: Mapping[str, object]) -> str:
    """The file's text with another camera after the last one."""
    cameras, lines = _cameras(file, text)
    end = _span(cameras.value[-1], lines)[1]
    indent = " " * cameras.start_mark.column
    return "".join([*lines[:end], _item(entry, indent), *lines[end:]])


def _exchanged(file: Path, text: str, camera_id: str, entry: Mapping[str, object] | None) -> str:
    """The file's text with another entry in the place of a camera, or with nothing there."""
    cameras, lines = _cameras(file, text)
    number = next(k for k, node in enumerate(cameras.value) if camera_id == _id_of(node))
    item = cameras.value[number]
    start, end = _span(item, lines)
    new: list[str] = []
    if entry is not None and item.flow_style:
        old = yaml.safe_load(text)["cameras"][number]
        kept = {key: value for key, value in old.items() if key not in FOUND_KEYS}
        new = [_item(dict(entry) | kept, " " * cameras.start_mark.column)]
    elif entry is not None:
        new = _merged(item, lines, start, end, entry)
    return "".join([*lines[:start], *new, *lines[end:]])


def _merged(
    item: yaml.MappingNode, lines: list[str], start: int, end: int, entry: Mapping[str, object]
) -> list[str]:
    """Lines of a camera with other values: keys set by hand, comments and order stay."""
    column = item.value[0][0].start_mark.column
    begins = [key.start_mark.line for key, _ in item.value]
    dash = lines[begins[0]][:column]  # or blanks, where the dash has a line of its own
    new = lines[start : begins[0]]
    first = len(new)
    for (key, value), begin, stop in zip(item.value, begins, [*begins[1:], end], strict=True):
        own = lines[begin:stop]
        own[0] = " " * column + own[0][column:]  # without the dash
        changed = yaml.safe_load(yaml.serialize(value)) != entry.get(key.value)
        if key.value in FOUND_KEYS and changed:
            comments = [line for line in own if line.strip().startswith("#")]
            given = {key.value: entry[key.value]} if key.value in entry else {}
            own = [*_block(given, " " * column), *comments]
            if given and (behind := _comment_behind(value, lines)):
                own[0] = own[0].rstrip("\n") + f"  {behind}\n"
        new += own
    there = {key.value for key, _ in item.value}
    new += _block({k: v for k, v in entry.items() if k not in there}, " " * column)
    new[first] = dash + new[first][column:]
    return new


def _comment_behind(value: yaml.Node, lines: list[str]) -> str:
    """The comment behind a value on its line; empty for none, and for values of several lines."""
    end = value.end_mark
    if value.start_mark.line != end.line:  # or the end is where the next key begins
        return ""
    found = re.search(r"\s#.*", lines[end.line][end.column :])
    return found[0].strip() if found else ""


def _cameras(file: Path, text: str) -> tuple[yaml.SequenceNode, list[str]]:
    """The list of cameras in a fleet file's text, and the text's lines."""
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    assert isinstance(root, yaml.MappingNode)  # it was read as a fleet
    cameras = next(value for key, value in root.value if key.value == "cameras")
    if cameras.flow_style or not isinstance(cameras, yaml.SequenceNode):
        found = "a list in brackets" if cameras.flow_style else "cameras by their names"
        expected = "one camera per '-', as this command edits them"
        raise InputFileError(f"{file}, key 'cameras'", found, expected)
    return cameras, text.splitlines(keepends=True)


def _id_of(camera: yaml.MappingNode) -> str:
    return next((str(value.value) for key, value in camera.value if key.value == "id"), "")


def _span(camera: yaml.MappingNode, lines: list[str]) -> tuple[int, int]:
    """First line of a camera's entry and the one after its last, comments behind it left out."""
    start = camera.start_mark.line
    while start and not lines[start].lstrip().startswith("-"):
        start -= 1  # the dash has a line of its own, or an anchor beside it
    end = camera.end_mark.line + int(bool(camera.flow_style))
    while end > start and not lines[end - 1].strip(" \n").partition("#")[0].strip():
        end -= 1  # comments and empty lines that follow belong to what comes next
    return start, end


def _item(entry: Mapping[str, object], indent: str) -> str:
    first, *rest = _block(entry, f"{indent}  ")
    return "".join([f"{indent}- {first.lstrip()}", *rest])


def _block(values: Mapping[str, object], indent: str) -> list[str]:
    """Lines of keys with their values."""
    if not values:
        return []
    text = yaml.safe_dump(
        dict(values), sort_keys=False, allow_unicode=True, default_flow_style=None
    )
    if text.startswith("{"):  # PyYAML's way where no value is a list or has keys
        text = yaml.safe_dump(dict(values), allow_unicode=True, default_flow_style=False)
    return [f"{indent}{line}\n" for line in text.splitlines()]
