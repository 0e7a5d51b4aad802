"""Vehicle classes as traffic counts have them, from COCO's classes and lengths."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, StrictInt

from geoorbit_ros.core.class_names import COCO_NAMES, class_text
from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.core.tables import BUS, CAR, MOTORCYCLE, TRUCK, UNKNOWN_CLASS
from geoorbit_ros.storage.yaml_file import read_yaml

BICYCLE = 1
"""COCO's number."""
UNKNOWN = "unknown"
MOVING_CLASSES = (UNKNOWN_CLASS, BICYCLE, CAR, MOTORCYCLE, BUS, TRUCK)
"""Classes that drive in lanes."""


@dataclass(frozen=True, slots=True)
class ClassRule:
    """Vehicles of some classes and lengths, and what they count as.

    Attributes:
        category: Name that the count has for them.
        class_ids: COCO's numbers, -1 unknown.
        from_m: Least length; NaN lengths fit rules without bounds only.
        below_m: Lengths from here on don't fit.
    """

    category: str
    class_ids: tuple[int, ...]
    from_m: float = 0.0
    below_m: float = float("inf")


@dataclass(frozen=True, slots=True)
class ClassScheme:
    """A way to class vehicles; the first rule that fits decides.

    Attributes:
        name: What users call it.
        categories: Names in the order of tables; `unknown` is always the last.
        rules: See `ClassRule`.
        heavy: Which categories are heavy vehicles.
    """

    name: str
    categories: tuple[str, ...]
    rules: tuple[ClassRule, ...]
    heavy: frozenset[str]

    def category_of(
        self, class_id: NDArray[np.int64], length_m: NDArray[np.float64]
    ) -> NDArray[np.int64]:
        """(N,) index of each vehicle's category.

        Args:
            class_id: (N,) COCO's numbers.
            length_m: (N,) lengths, NaN where not known.
        """
        found = np.full(len(class_id), len(self.categories) - 1, np.int64)
        for rule in reversed(self.rules):
            fits = np.isin(class_id, rule.class_ids)
            if rule.from_m > 0.0 or np.isfinite(rule.below_m):
                fits &= (length_m >= rule.from_m) & (length_m < rule.below_m)
            found[fits] = self.categories.index(rule.category)
        return found

    @property
    def is_heavy(self) -> NDArray[np.bool_]:
        """(C,) whether each category is of heavy vehicles."""
        return np.array([name in self.heavy for name in self.categories])


def _coco() -> ClassScheme:
    used = [k for k in MOVING_CLASSES if k != UNKNOWN_CLASS]
    names = [class_text(k) for k in used]
    rules = tuple(ClassRule(name, (k,)) for name, k in zip(names, used, strict=True))
    return ClassScheme("coco", (*names, UNKNOWN), rules, frozenset({"bus", "truck"}))


_SHORT_M, _LONG_M = 6.55, 14.94
"""21.5 and 49 feet: short, medium and long vehicles (FHWA Traffic Monitoring Guide, length-based
classification; E. Minge et al. 2012, "Loop- and Length-Based Vehicle Classification")."""
_ANY = (UNKNOWN_CLASS, CAR, MOTORCYCLE, BUS, TRUCK)


def _fhwa() -> ClassScheme:
    rules = (
        ClassRule("short", _ANY, 0.01, _SHORT_M),
        ClassRule("medium", _ANY, _SHORT_M, _LONG_M),
        ClassRule("long", _ANY, _LONG_M),
        ClassRule("short", (CAR, MOTORCYCLE)),  # nothing shows their length
        ClassRule("medium", (BUS, TRUCK)),
    )
    names = ("short", "medium", "long", UNKNOWN)
    return ClassScheme("fhwa3", names, rules, frozenset({"medium", "long"}))


_TRAILER_M = 6.5
"""A longer car has a trailer. Chosen: vans are up to 6 m long; lengths are known within 0.5 m."""
_COMBINATION_M = 12.0
"""Longest single vehicle in Europe (Directive 96/53/EC); longer lorries have a trailer."""


def _tls() -> ClassScheme:
    """German TLS 2012: 5+1 classes; motorcycles and vans are like cars."""
    rules = (
        ClassRule("car_with_trailer", (CAR,), _TRAILER_M),
        ClassRule("lorry_combination", (TRUCK,), _COMBINATION_M),
        ClassRule("car", (CAR, MOTORCYCLE)),
        ClassRule("lorry", (TRUCK,)),
        ClassRule("bus", (BUS,)),
    )
    names = ("car", "car_with_trailer", "lorry", "lorry_combination", "bus", UNKNOWN)
    return ClassScheme("tls5+1", names, rules, frozenset(names[2:5]))


SCHEMES: Mapping[str, ClassScheme] = {s.name: s for s in (_coco(), _fhwa(), _tls())}
"""Schemes by name."""


def scheme_text(scheme: ClassScheme) -> str:
    """A scheme as it is stored beside what was counted with it; the same scheme, the same text."""
    rules = [[r.category, list(r.class_ids), r.from_m, r.below_m] for r in scheme.rules]
    heavy = [name for name in scheme.categories if name in scheme.heavy]
    content = {"name": scheme.name, "categories": scheme.categories, "heavy": heavy}
    return json.dumps(content | {"rules": rules})


def stored_scheme(text: str) -> ClassScheme:
    """The scheme of `scheme_text`.

    Raises:
        ParameterError: Another text.
    """
    try:
        content = json.loads(text)
        rules = tuple(ClassRule(c, tuple(ids), low, high) for c, ids, low, high in content["rules"])
        names, heavy = tuple(content["categories"]), frozenset(content["heavy"])
        return ClassScheme(content["name"], names, rules, heavy)
    except (ValueError, KeyError, TypeError):
        raise ParameterError("stored class scheme", f"'{text}'", "a scheme") from None


class RuleEntry(BaseModel):
    """One rule of a file; see `ClassRule`."""

    model_config = ConfigDict(extra="forbid")

    category: str = Field(min_length=1)
    classes: list[str | StrictInt] = Field(min_length=1)
    from_m: float = Field(0.0, ge=0.0, allow_inf_nan=False)
    below_m: float = Field(float("inf"), gt=0.0)


class SchemeFile(BaseModel):
    """A scheme of one's own, as a small YAML file describes it.

    ```yaml
    rules:                     # the first that fits decides
      - {category: van, classes: [car], from_m: 5.2}
      - {category: car, classes: [car, motorcycle]}
      - {category: lorry, classes: [truck, bus]}
    heavy: [lorry]
    ```
    """

    model_config = ConfigDict(extra="forbid")

    rules: list[RuleEntry] = Field(min_length=1)
    heavy: list[str] = []


def scheme_of(content: SchemeFile, place: str) -> ClassScheme:
    """The scheme of a file.

    Args:
        content: What the file says.
        place: The file, for errors and as the scheme's name.

    Raises:
        ParameterError: A class that COCO doesn't have, or a heavy category without a rule.
    """
    rules = tuple(
        ClassRule(
            entry.category,
            tuple(_class_id(f"{place}, rule {k + 1}", c) for c in entry.classes),
            entry.from_m,
            entry.below_m,
        )
        for k, entry in enumerate(content.rules)
    )
    for k, rule in enumerate(rules):
        where = f"{place}, rule {k + 1}"
        if rule.category == "all":
            raise ParameterError(where, "category 'all'", "another name: 'all' is all of them")
        if not rule.from_m < rule.below_m:
            found = f"from_m {rule.from_m:g}, below_m {rule.below_m:g}"
            raise ParameterError(where, found, "from_m below below_m")
    names = list(dict.fromkeys(rule.category for rule in rules if rule.category != UNKNOWN))
    if not set(content.heavy) <= set(names):
        found = ", ".join(content.heavy)
        raise ParameterError(f"{place}, heavy", found, f"categories of: {', '.join(names)}")
    return ClassScheme(place, (*names, UNKNOWN), rules, frozenset(content.heavy))


def named_scheme(given: str, place: str) -> ClassScheme:
    """A scheme by its name, or from a YAML file.

    Args:
        given: `coco`, `fhwa3`, `tls5+1`, or the path of a file.
        place: Who names it, for errors.

    Raises:
        GeoOrbitError: Neither, or a file that is no scheme.
    """
    if given in SCHEMES:
        return SCHEMES[given]
    if not Path(given).is_file():
        raise ParameterError(place, f"'{given}'", f"{', '.join(SCHEMES)}, or a YAML file")
    return scheme_of(read_yaml(Path(given), SchemeFile, "class scheme"), given)


def _class_id(place: str, given: str | int) -> int:
    if isinstance(given, int):
        if given not in range(UNKNOWN_CLASS, len(COCO_NAMES)):
            raise ParameterError(place, f"class {given}", f"-1 to {len(COCO_NAMES) - 1}")
        return given
    if given == UNKNOWN:
        return UNKNOWN_CLASS
    if given in COCO_NAMES:
        return COCO_NAMES.index(given)
    raise ParameterError(place, f"class '{given}'", "a COCO name or number, or unknown")
