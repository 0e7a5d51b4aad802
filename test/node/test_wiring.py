"""Launch file against the nodes that run."""

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from made_up_camera import MadeUpCamera

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.fleet.fleet_io import load_fleet
from geoorbit_ros.fleet.plan import plan_fleet
from geoorbit_ros.nodes.bag_player import BagPlayerNode
from geoorbit_ros.nodes.camera import CameraNode
from geoorbit_ros.nodes.detector import DetectorNode
from geoorbit_ros.nodes.homography import HomographyNode
from geoorbit_ros.nodes.lane_geometry import LaneGeometryNode
from geoorbit_ros.nodes.overlay import OverlayNode
from geoorbit_ros.nodes.recorder import RecorderNode
from geoorbit_ros.nodes.tracker import TrackerNode
from geoorbit_ros.nodes.traffic import TrafficNode
from geoorbit_ros.nodes.view_watch import ViewWatchNode
from geoorbit_ros.parameters import load_schema

ROOT = Path(__file__).parents[2]
NODES = {
    n.name: n
    for n in (
        BagPlayerNode,
        CameraNode,
        DetectorNode,
        HomographyNode,
        LaneGeometryNode,
        OverlayNode,
        RecorderNode,
        TrackerNode,
        TrafficNode,
        ViewWatchNode,
    )
}


class Recorded:
    """Stands in for every class of launch and launch_ros: keeps what it was made with."""

    def __init__(self, *arguments: Any, **named: Any) -> None:
        self.arguments, self.named = arguments, named


@pytest.fixture
def launch_file(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The launch file as a module; launch itself has no wheel."""
    for name in (
        "launch",
        "launch.actions",
        "launch.conditions",
        "launch.substitutions",
        "launch_ros",
        "launch_ros.actions",
        "launch_ros.parameter_descriptions",
        "launch_ros.substitutions",
    ):
        module = ModuleType(name)
        module.__getattr__ = lambda key: type(key, (Recorded,), {})  # type: ignore[method-assign]
        monkeypatch.setitem(sys.modules, name, module)
    spec = importlib.util.spec_from_file_location("wiring", ROOT / "launch" / "geoorbit.launch.py")
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def launched(launch_file: ModuleType) -> list[Recorded]:
    """The entities of the launch description, those of one camera among them."""
    entities: list[Recorded] = launch_file.generate_launch_description().arguments[0]
    return entities + list(launch_file.one_camera_nodes())


def of_kind(entities: list[Recorded], kind: str) -> list[Recorded]:
    return [entity for entity in entities if type(entity).__name__ == kind]


def test_the_launch_file_starts_every_node_with_parameters_it_has(launched: list[Recorded]) -> None:
    started = [n.named for n in of_kind(launched, "Node") if n.named["package"] == "geoorbit_ros"]
    assert {node["executable"] for node in started} == set(NODES)
    for node in started:
        known = {spec.name for spec in load_schema(node["executable"])} | {"use_sim_time"}
        for parameters in node["parameters"]:
            if isinstance(parameters, dict):
                assert set(parameters) <= known


def test_the_launch_file_declares_what_it_uses_and_uses_what_it_declares(
    launched: list[Recorded],
) -> None:
    declared = {entity.arguments[0] for entity in of_kind(launched, "DeclareLaunchArgument")}
    text = (ROOT / "launch" / "geoorbit.launch.py").read_text()
    used = set(re.findall(r'LaunchConfiguration\("(\w+)"\)', text))
    assert used == declared


@pytest.mark.parametrize(
    ("camera_id", "calibration", "source", "bag", "said"),
    [
        ("", "c.csv", "a.mp4", "", "'camera_id': found nothing"),
        ("north", "", "a.mp4", "", "'calibration': found nothing"),
        ("north", "nowhere.csv", "a.mp4", "", "no file 'nowhere.csv'"),
        ("north", "c.csv", "", "", "'source', 'bag': found neither"),
        ("north", "c.csv", "a.mp4", "a_bag", "'source', 'bag': found both"),
        ("north", "c.csv", "", "a_bag", "no file 'a_bag'"),
    ],
)
def test_what_a_launch_lacks_is_said_before_any_node_starts(
    launch_file: ModuleType,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    camera_id: str,
    calibration: str,
    source: str,
    bag: str,
    said: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("c.csv").touch()
    with pytest.raises(ParameterError, match=said):
        launch_file.check_one_camera(camera_id, calibration, source, bag)


def test_a_launch_with_all_that_one_camera_needs_goes_on(
    launch_file: ModuleType, camera: MadeUpCamera
) -> None:
    launch_file.check_one_camera("north", str(camera.calibration), "rtsp://host/stream", "")
    launch_file.check_one_camera("north", str(camera.calibration), "", str(camera.bag))


def test_launch_makes_the_graph_of_geoorbit_up_from_the_same_file(
    launch_file: ModuleType, camera: MadeUpCamera, tmp_path: Path
) -> None:
    file = tmp_path / "fleet.yaml"
    file.write_text(
        f"name: pair\ncameras:\n  - id: north\n    source: bag:{camera.bag}\n"
        f"    calibration: {camera.calibration}\nrecorder: {{}}\nviewer: {{}}\n"
    )
    launched = launch_file.fleet_nodes(str(file), str(tmp_path / "out"))
    fleet, _ = load_fleet(file)
    planned = [n for plan in plan_fleet(fleet, tmp_path, tmp_path / "out") for n in plan.nodes]
    assert [(n.named["executable"], n.named["namespace"]) for n in launched] == [
        (node.executable, node.namespace) for node in planned
    ]
    assert [n.named["parameters"] for n in launched] == [[dict(n.parameters)] for n in planned]
    assert (tmp_path / "out" / "recordings").is_dir()


@pytest.mark.usefixtures("launched")
def test_the_layout_and_the_sample_parameters_that_are_launched_exist() -> None:
    text = (ROOT / "launch" / "geoorbit.launch.py").read_text()
    for name in ("one_camera.yaml", "geoorbit.rviz"):
        assert name in text
        assert (ROOT / "params" / name).is_file()
