"""Parameters: schemas and structs agree, and a bad value is one sentence."""

import subprocess
import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import pytest
import yaml
from rclpy.node import Node
from rclpy.parameter import Parameter

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.nodes.bag_player import BagPlayerNode
from geoorbit_ros.nodes.camera import CameraNode
from geoorbit_ros.nodes.detector import DetectorNode
from geoorbit_ros.nodes.homography import HomographyNode
from geoorbit_ros.nodes.lane_geometry import LaneGeometryNode, LaneGeometryParameters
from geoorbit_ros.nodes.recorder import RecorderNode
from geoorbit_ros.nodes.support.composition import Composition
from geoorbit_ros.nodes.support.process import run_node
from geoorbit_ros.nodes.tracker import TrackerNode
from geoorbit_ros.parameters import NodeParameters, load_schema, spec_by_name

PARAMS = Path(__file__).parents[2] / "params"
NODES = (
    BagPlayerNode,
    CameraNode,
    DetectorNode,
    HomographyNode,
    LaneGeometryNode,
    RecorderNode,
    TrackerNode,
)
KINDS = {"bool": "bool", "int": "int", "double": "float", "string": "str"}


def declare(nodes: Composition, **overrides: object) -> NodeParameters[LaneGeometryParameters]:
    values = [Parameter(key, value=value) for key, value in overrides.items()]
    node = Node("n", context=nodes.context, namespace="cam", parameter_overrides=values)
    nodes.add(node)
    return NodeParameters(node, LaneGeometryParameters, "lane_geometry")


@pytest.mark.parametrize("node_class", NODES)
def test_struct_and_schema_name_the_same_parameters_with_the_same_types(node_class: Any) -> None:
    schema = {spec.name: KINDS[spec.kind] for spec in load_schema(node_class.name)}
    assert {f.name: f.type for f in fields(node_class.struct)} == schema


@pytest.mark.parametrize("node_class", NODES)
def test_defaults_satisfy_their_own_schema_unless_they_must_be_given(node_class: Any) -> None:
    for spec in load_schema(node_class.name):
        if not spec.not_empty or spec.default:
            assert spec.checked(spec.default, "default") is not None


@pytest.mark.parametrize("file", ["one_camera.yaml", "thrifty_federation.yaml"])
def test_a_sample_file_holds_known_parameters_within_their_bounds(file: str) -> None:
    content = yaml.safe_load((PARAMS / file).read_text())
    assert content
    for key, entry in content.items():
        schema = {spec.name: spec for spec in load_schema(key.removeprefix("/**/"))}
        for name, value in entry["ros__parameters"].items():
            schema[name].checked(value, key)


def test_overrides_reach_the_struct_and_whole_numbers_become_doubles(nodes: Composition) -> None:
    parameters = declare(nodes, update_period_s=3, estimator="geolane").value
    assert (parameters.update_period_s, parameters.estimator) == (3.0, "geolane")
    assert type(parameters.update_period_s) is float


@pytest.mark.parametrize(
    ("name", "value", "found", "expected"),
    [
        ("smoothing", 0.5, "0.5", "a number from 1 to 20"),
        ("smoothing", "much", "'much'", "a number from 1 to 20"),
        ("smoothing", float("nan"), "nan", "a number from 1 to 20"),
        ("queue_depth", 1.5, "1.5", "a whole number from 0 to 100000"),
        ("queue_depth", True, "True", "a whole number from 0 to 100000"),
        ("publish_tentative", 1, "1", "true or false"),
        ("estimator", "magic", "'magic'", "curvilinear or geolane or FILE.py:CLASS"),
        ("restart_jump_s", 0.0, "0.0", "a number above 0"),
        ("frame_id", "", "''", "text, not empty"),
    ],
)
def test_a_bad_value_names_node_parameter_value_and_expectation(
    nodes: Composition, name: str, value: Any, found: str, expected: str
) -> None:
    with pytest.raises(ParameterError) as caught:
        declare(nodes, **{name: value})
    assert str(caught.value) == (
        f"node '/cam/n', parameter '{name}': found {found}, expected {expected}"
    )


def test_a_refused_change_leaves_all_parameters_as_they_were(nodes: Composition) -> None:
    parameters = declare(nodes)
    before = parameters.value
    node = parameters_node(nodes)
    changes = [Parameter("angle", value=0.9), Parameter("smoothing", value=99.0)]
    result = node.set_parameters_atomically(changes)
    assert not result.successful
    assert "'smoothing': found 99.0, expected a number from 1 to 20" in result.reason
    assert parameters.value is before
    assert node.set_parameters_atomically(changes[:1]).successful
    assert parameters.value.angle == 0.9


def parameters_node(nodes: Composition) -> Node:
    return nodes._nodes[-1]


def test_a_struct_that_is_not_its_schema_is_refused(nodes: Composition) -> None:
    @dataclass(frozen=True)
    class Other:
        estimator: str
        invented: int

    node = nodes.add(Node("n", context=nodes.context))
    with pytest.raises(ParameterError, match="invented"):
        NodeParameters(node, Other, "lane_geometry")


@dataclass(frozen=True)
class Renamed:
    """Of the schema below."""

    validate_every: int


@pytest.fixture
def renamed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "renamed.yaml").write_text(
        "renamed:\n  validate_every: {type: int, default_value: 4, description: Of cameras.,\n"
        "    renamed_from: judge_every, validation: {bounds<>: [0, 9]}}\n"
    )
    monkeypatch.setattr(
        "geoorbit_ros.parameters.share_path", lambda name: tmp_path / Path(name).name
    )


@pytest.mark.parametrize(
    ("given", "value", "warned"),
    [
        ({}, 4, False),
        ({"validate_every": 5}, 5, False),
        ({"judge_every": 6}, 6, True),
        ({"judge_every": 6, "validate_every": 7}, 7, True),
    ],
)
@pytest.mark.usefixtures("renamed")
def test_the_old_name_of_a_parameter_works_with_a_warning(
    nodes: Composition, capfd: pytest.CaptureFixture[str], given: Any, value: int, warned: bool
) -> None:
    overrides = [Parameter(key, value=number) for key, number in given.items()]
    node = nodes.add(Node("n", context=nodes.context, parameter_overrides=overrides))
    assert NodeParameters(node, Renamed, "renamed").value == Renamed(value)
    said = "'judge_every' is now called 'validate_every'" in capfd.readouterr().err
    assert said == warned
    assert not node.has_parameter("judge_every")
    assert node.get_parameter("validate_every").value == value
    assert set(spec_by_name("renamed")) == {"judge_every", "validate_every"}


@pytest.mark.usefixtures("renamed")
def test_a_bad_value_under_the_old_name_is_refused(nodes: Composition) -> None:
    overrides = [Parameter("judge_every", value=10)]
    node = nodes.add(Node("n", context=nodes.context, parameter_overrides=overrides))
    with pytest.raises(ParameterError, match="'validate_every': found 10, expected"):
        NodeParameters(node, Renamed, "renamed")


def test_a_parameter_that_a_node_has_not_is_warned_of_with_the_nearest_name(
    nodes: Composition, capfd: pytest.CaptureFixture[str]
) -> None:
    given = {"estimater": "geolane", "update_period_s": 3.0}
    nodes.make(LaneGeometryNode, "north", given)
    said = capfd.readouterr().err
    assert "parameter 'estimater' has no effect" in said
    assert "expected 'estimator'?" in said
    assert said.count("has no effect") == 1


def test_help_shows_every_parameter_and_starts_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_node(LaneGeometryNode, ["--help"]) == 0
    shown = capsys.readouterr().out
    assert all(f"  {spec.name}: {spec.expected}" in shown for spec in load_schema("lane_geometry"))


def test_words_that_ros_does_not_take_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_node(LaneGeometryNode, ["--estimator", "geolane"]) == 2
    assert "found '--estimator', expected --ros-args" in capsys.readouterr().err


def test_a_node_that_is_a_folder_starts_as_the_others_do() -> None:
    words = [sys.executable, "-m", "geoorbit_ros.nodes.sumo_bridge", "--help"]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert "  network: text, not empty" in done.stdout
    assert done.stderr == ""
