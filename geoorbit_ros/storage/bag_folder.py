"""The files of a bag: its folder, one of its files, its metadata.yaml, or a folder around it.

metadata.yaml is written last, and by many programs: it is used for the names of files and for
counts to compare with, and all else comes from the files themselves.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any

import yaml

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.input_report import Treatment
from geoorbit_ros.storage.bag_file import EXPECTED, Faults, recognise
from geoorbit_ros.storage.yaml_loader import load_bounded

METADATA = "metadata.yaml"
_NAME = re.compile(r"\.(mcap|db3)(\.zstd|\.zst)?$")
"""How rosbag2 names the files of a bag."""


def bag_files(path: Path, faults: Faults) -> tuple[list[Path], dict[str, int]]:
    """The files of a bag in their order, and how many messages the metadata says they have.

    Args:
        path: What a user named.
        faults: Takes what is missing.

    Raises:
        InputFileError: Nothing there, no bag, or several.
    """
    if not path.exists():
        raise InputFileError(str(path), "no such file or folder", EXPECTED)
    if path.is_file() and path.name != METADATA:
        others = len(_stored_in(path.parent)) - 1
        if others > 0 and (path.parent / METADATA).is_file():
            text = f"one of {others + 1} files of its folder; the folder names all of them"
            faults.note(text, Treatment.NOTED)
        return [path], {}
    folder = path.parent if path.is_file() else path
    if not path.is_file():
        folder = _only_bag_in(folder, faults)
    there = _stored_in(folder)
    metadata = _metadata(folder, faults)
    if metadata is None:
        if not there:
            raise InputFileError(str(path), "a folder without a bag's files", EXPECTED)
        return there, {}
    return _named_files(path, folder, metadata, there, faults), metadata.counts


def _named_files(
    path: Path, folder: Path, metadata: _Metadata, there: list[Path], faults: Faults
) -> list[Path]:
    """The files that the metadata names, as far as they are there."""
    named = [folder / PurePath(str(name)).name for name in metadata.relative_file_paths]
    files = [file for name in named if (file := _found(name)) is not None]
    missing = [name for name in named if _found(name) is None]
    if not files:
        if not there:
            found = f"{METADATA} without the files that it names ({missing[0].name})"
            raise InputFileError(str(path), found, EXPECTED)
        faults.note(f"{METADATA} names other files than those that are there, which are read")
        metadata.counts.clear()
        return there
    for name in missing:
        text = f"{name.name} of the bag's {len(named)} files is missing"
        count = metadata.counts.get(name.name, 0)
        faults.leave_out(count, text, str(folder / METADATA), absent=True)
    beside = [file.name for file in there if file not in files]
    if beside:
        names = ", ".join(beside[:3])
        faults.note(f"{names} beside the bag's files, not named in {METADATA}: not read")
    if metadata.whole is not None and len(files) == 1 and not missing:
        metadata.counts.setdefault(files[0].name, metadata.whole)
    return files


def _only_bag_in(folder: Path, faults: Faults) -> Path:
    """The folder, or the one bag folder in it."""
    if (folder / METADATA).is_file() or _stored_in(folder):
        return folder
    bags = [
        child
        for child in sorted(folder.iterdir())
        if child.is_dir() and ((child / METADATA).is_file() or _stored_in(child))
    ]
    if len(bags) > 1:
        names = ", ".join(bag.name for bag in bags[:5])
        raise InputFileError(str(folder), f"{len(bags)} bags ({names})", "the folder of one bag")
    if not bags:
        foreign = sorted(folder.glob("*.bag"))
        if foreign:
            recognise(foreign[0])  # says what it is
        raise InputFileError(str(folder), "a folder without a bag's files", EXPECTED)
    faults.note(f"the bag is in {bags[0].name}", Treatment.NOTED)
    return bags[0]


def _stored_in(folder: Path) -> list[Path]:
    """Files of a bag in a folder, parts in the order of their numbers."""
    files = [file for file in folder.iterdir() if _NAME.search(file.name) and file.is_file()]

    def order(file: Path) -> tuple[str, int]:
        stem, _, number = _NAME.sub("", file.name).rpartition("_")
        return (stem, int(number)) if number.isdigit() else (file.name, 0)

    return sorted(files, key=order)


def _found(file: Path) -> Path | None:
    """A file that the metadata names, also where it was packed or unpacked since."""
    plain = file.with_name(re.sub(r"\.(zstd|zst)$", "", file.name))
    for name in (file, plain, *(plain.with_name(plain.name + end) for end in (".zstd", ".zst"))):
        if name.is_file():
            return name
    return None


@dataclass(slots=True)
class _Metadata:
    """What is used of metadata.yaml; the rest is in the files themselves.

    Attributes:
        relative_file_paths: Names of the bag's files.
        counts: Messages by file, where it says so (since version 5).
        whole: Messages in all files.
    """

    relative_file_paths: list[object]
    counts: dict[str, int] = field(default_factory=dict)
    whole: int | None = None


def _metadata(folder: Path, faults: Faults) -> _Metadata | None:
    """What the metadata says of the files, None where it is missing or can't be used."""
    file = folder / METADATA
    if not file.is_file():
        faults.note(f"no {METADATA} (a recording that was cut off?); all files there are read")
        return None
    try:
        content: Any = load_bounded(file.read_text(encoding="utf-8", errors="replace"))
        info: Mapping[str, Any] = content["rosbag2_bagfile_information"]
        paths = info["relative_file_paths"]
        if not isinstance(paths, list) or not paths:
            raise TypeError("no files")
        found = _Metadata(paths)
        for part in info.get("files") or []:
            found.counts[PurePath(part["path"]).name] = int(part["message_count"])
        if isinstance(info.get("message_count"), int):
            found.whole = info["message_count"]
    except (yaml.YAMLError, OSError, KeyError, TypeError, ValueError, AttributeError):
        faults.note(f"{METADATA} can't be read; all files there are read")
        return None
    return found
