"""Which vehicles the classes of a file are: COCO's numbers, names, other data sets' numbers."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import yaml

from geoorbit_ros.core.class_names import COCO_NAMES, vehicle_class
from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.core.tables import UNKNOWN_CLASS
from geoorbit_ros.storage.yaml_loader import load_bounded

OTHER_CLASS = 80
"""The number of classes that are no motor vehicle and none of COCO's 80."""

NUMBERED: dict[str, dict[int, str]] = {
    "coco": dict(enumerate(COCO_NAMES)),
    "visdrone": {
        0: "ignored region", 1: "pedestrian", 2: "people", 3: "bicycle", 4: "car", 5: "van",
        6: "truck", 7: "tricycle", 8: "awning-tricycle", 9: "bus", 10: "motor", 11: "others",
    },
    "detrac": {0: "others", 1: "car", 2: "bus", 3: "van", 4: "others"},
    "mot": {
        1: "pedestrian", 2: "person on vehicle", 3: "car", 4: "bicycle", 5: "motorbike",
        6: "non motorized vehicle", 7: "static person", 8: "distractor", 12: "reflection",
    },
}  # fmt: skip
"""Class numbers of data sets. COCO: Lin et al. 2014. VisDrone: Zhu et al. 2021, its categories.
UA-DETRAC: its evaluation toolkit. MOT16: Milan et al. 2016, table 1."""


def class_table(text: str) -> dict[str, str]:
    """Names of classes by their number, as the option `--classes` gives them.

    Args:
        text: A data set of `NUMBERED`; `0=car,1=truck`; or a YAML file with such a mapping or with
            `names`, as Ultralytics' data files have.

    Raises:
        ParameterError: None of these.
    """
    expected = f"{', '.join(NUMBERED)}, 0=car,1=truck, or a YAML file with numbers and names"
    if text.lower() in NUMBERED:
        return {str(k): name for k, name in NUMBERED[text.lower()].items()}
    pairs = [part.split("=", 1) for part in text.split(",")]
    if all(len(pair) == 2 for pair in pairs):
        table: dict[str, str] = {}
        for number, name in ((number.strip(), name.strip()) for number, name in pairs):
            if number in table:
                found = f"class {number} twice in '{text}'"
                raise ParameterError("option --classes", found, "each class once")
            table[number] = name
        return table
    try:
        content = load_bounded(Path(text).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError):
        raise ParameterError("option --classes", repr(text), expected) from None
    names = content.get("names", content) if isinstance(content, Mapping) else content
    if isinstance(names, list):
        names = dict(enumerate(names))
    if not isinstance(names, Mapping):
        raise ParameterError("option --classes", repr(text), expected)
    return {str(k): str(name) for k, name in names.items()}


def class_number(name: str, table: Mapping[str, str]) -> int:
    """COCO number of a class as a file writes it: a number or a word.

    Args:
        name: What the file has; empty for none.
        table: Names by number, from `class_table`; numbers that it doesn't have are COCO's.
    """
    text = name.strip()
    if not text:
        return UNKNOWN_CLASS
    number = _whole(text)
    if number is not None:
        if str(number) not in table:
            return number if -(2**31) <= number < 2**31 else OTHER_CLASS
        text = table[str(number)]
    vehicle = vehicle_class(text)
    if vehicle is not None:
        return vehicle
    plain = re.sub(r"[_-]+", " ", text.lower())
    return COCO_NAMES.index(plain) if plain in COCO_NAMES else OTHER_CLASS


def _whole(text: str) -> int | None:
    try:
        value = float(text.replace(",", "."))
    except ValueError:
        return None
    return int(value) if value.is_integer() else None
