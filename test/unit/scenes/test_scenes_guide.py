"""docs/scenes.md: its example is a scene, and it names every key with the default it has."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from made_scenes import true_lanes
from pydantic import BaseModel

from geoorbit_ros.scenes.road_plan import Road
from geoorbit_ros.scenes.scene import (
    VEHICLE_TYPES,
    Camera,
    DetectorFaults,
    Flow,
    Scene,
    Traffic,
    load_scene,
)
from geoorbit_ros.storage.yaml_file import StrictModel

GUIDE = (Path(__file__).parents[3] / "docs" / "scenes.md").read_text(encoding="utf-8")


def rows() -> dict[str, list[str]]:
    """Cells of each table row, by every key that its first cell names."""
    found = {}
    for line in GUIDE.splitlines():
        if line.startswith("| `"):
            name, *cells = (cell.strip() for cell in line.strip("|").split("|"))
            for key in re.findall(r"`([^`]+)`", name):
                found[key] = cells
    return found


def test_the_example_is_a_scene(tmp_path: Path) -> None:
    block = re.search(r"```yaml\n(.*?)```", GUIDE, re.DOTALL)
    assert block
    file = tmp_path / "junction_west.yaml"
    file.write_text(block[1], encoding="utf-8")
    scene = load_scene(file)
    lanes = true_lanes(scene)
    assert len(lanes) == 5
    # The exit begins with its lane, and ends further right than the other lanes.
    assert max(lane.heading_deg for lane in lanes if lane.heading_deg < 180.0) > 70.0


def test_every_key_is_named() -> None:
    models = [m for m in StrictModel.__subclasses__() if ".scenes." in m.__module__]
    assert len(models) > 5
    for model in models:
        for key in model.model_fields:
            assert re.search(rf"\b{key}\b", GUIDE), f"{model.__name__}.{key}"
    assert all(name in rows()["traffic.mix"][1] for name in VEHICLE_TYPES)


@pytest.mark.parametrize(
    ("prefix", "model"),
    [
        ("", Scene),
        ("roads[].", Road),
        ("traffic.", Traffic),
        ("traffic.flows[].", Flow),
        ("camera.", Camera),
        ("detector.", DetectorFaults),
    ],
)
def test_defaults_are_told_as_they_are(prefix: str, model: type[BaseModel]) -> None:
    checked = 0
    for key, field in model.model_fields.items():
        told = rows().get(prefix + key)
        if told is None or isinstance(field.default, BaseModel):
            continue
        checked += 1
        if field.is_required():
            assert told[0] == "", prefix + key
        elif isinstance(field.default, dict):
            assert told[0] == ", ".join(f"{k} {v}" for k, v in field.default.items())
        elif isinstance(field.default, tuple):
            assert told[0] == str(list(field.default))
        elif isinstance(field.default, bool):
            assert told[0] == str(field.default).lower(), prefix + key
        elif field.default is not None:
            number = re.match(r"-?[\d.]+", told[0])
            assert number, prefix + key
            assert float(number[0]) == field.default, prefix + key
    assert checked > 0
