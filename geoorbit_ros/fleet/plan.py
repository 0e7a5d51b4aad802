"""Which processes a fleet takes, and which nodes run in each."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

from geoorbit_ros.core.addresses import masked
from geoorbit_ros.core.errors import GeoOrbitError, InputFileError
from geoorbit_ros.core.plugins import FROM_FILES, is_file, plugin_file, registered
from geoorbit_ros.fleet.fleet_file import (
    RESERVED_NAMES,
    SERVER_KEY_NAME,
    Camera,
    Fleet,
    Value,
)
from geoorbit_ros.parameters import spec_by_name
from geoorbit_ros.storage.frames.open_source import local_path

BAG_IMAGE_SIZE = (1920, 1080)
"""Width and height of the images of a recording of boxes, which doesn't tell them: full HD."""
SERVER, TWIN, CARLA, VIEWER = SERVICES = "federated_server", "twin", "carla", "viewer"
"""Names of the processes that are no camera's."""
SERVER_KEY, ROSTER = f"{SERVER_KEY_NAME}.key", "roster.txt"


class FleetPlanError(GeoOrbitError):
    """A fleet that can't be started as it is asked for."""


SECRETS_VARIABLE = "GEOORBIT_SECRETS"
"""Environment variable in which a process gets its plan's `secrets`; other users can't read it."""
_NONE: Mapping[str, str] = MappingProxyType({})


def _each_text(content: Any, change: Callable[[str], str]) -> Any:
    """JSON content with every text changed that is a value."""
    if isinstance(content, str):
        return change(content)
    if isinstance(content, Mapping):
        return {key: _each_text(value, change) for key, value in content.items()}
    if isinstance(content, Sequence):
        return [_each_text(value, change) for value in content]
    return content


@dataclass(frozen=True, slots=True)
class FederationKeys:
    """Where the keys are, and the public ones.

    Attributes:
        folder: Holds `server.key`, `<camera>.key` and `roster.txt`.
        server: Public key in hex digits.
        cameras: The same by camera id.
    """

    folder: Path
    server: str
    cameras: dict[str, str]


@dataclass(frozen=True, slots=True)
class NodePlan:
    """One node.

    Attributes:
        executable: As in `ros2 run geoorbit_ros EXECUTABLE`.
        namespace: Its namespace; empty: none.
        parameters: Values that go before its defaults.
    """

    executable: str
    namespace: str = ""
    parameters: Mapping[str, Value] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ProcessPlan:
    """One process: nodes on one executor.

    Attributes:
        name: A camera's id, or one of `SERVICES`.
        nodes: In the order in which they start.
        first: Whether the others wait until it runs.
    """

    name: str
    nodes: tuple[NodePlan, ...]
    first: bool = False

    def to_json(self) -> str:
        """The plan as its process reads it, without passwords."""
        return json.dumps(_each_text(asdict(self), masked), indent=2)

    def secrets(self) -> dict[str, str]:
        """Addresses with a password, by what they are without it."""
        found: dict[str, str] = {}
        _each_text(asdict(self), lambda text: found.setdefault(masked(text), text))
        return {shown: text for shown, text in found.items() if shown != text}

    @staticmethod
    def from_json(text: str, place: str, secrets: Mapping[str, str] = _NONE) -> ProcessPlan:
        """Read a plan.

        Args:
            text: What `to_json` wrote.
            place: Where it was, for the error.
            secrets: As the plan's `secrets`.

        Raises:
            InputFileError: Not a plan.
        """
        try:
            content = _each_text(json.loads(text), lambda value: secrets.get(value, value))
            nodes = tuple(NodePlan(**node) for node in content["nodes"])
            return ProcessPlan(content["name"], nodes, content["first"])
        except (ValueError, KeyError, TypeError) as error:
            raise InputFileError(place, f"{type(error).__name__}: {error}", "a plan") from error


def plan_fleet(
    fleet: Fleet, base: Path, output: Path, keys: FederationKeys | None = None
) -> tuple[ProcessPlan, ...]:
    """The processes of a fleet in the order in which they start: what others wait for comes first.

    Args:
        fleet: The fleet.
        base: Folder that relative paths in the fleet file start from.
        output: Folder of logs, recordings and state.
        keys: Of the federation; None: nothing is signed (a plan to look at).

    Raises:
        FleetPlanError: Files that the fleet names and that are not there, all of them in one
            sentence, or a camera called like a service.
        ParameterError: A password that is not where the fleet says.
    """
    _check_names(fleet)
    _check_files(fleet, base)
    for camera in fleet.cameras:
        if camera.enabled:
            camera.address(base)
    return plan_nodes(fleet, base, output, keys)


def plan_nodes(
    fleet: Fleet, base: Path, output: Path, keys: FederationKeys | None = None
) -> tuple[ProcessPlan, ...]:
    """As `plan_fleet`, without a look at the files."""
    plans = []
    cameras = [camera for camera in fleet.cameras if camera.enabled]
    if fleet.federated_server and fleet.federated_server.enabled:
        wiring: dict[str, Value] = {"checkpoint": str(output / "state" / f"{SERVER}.npz")}
        if keys:
            files = {"roster": keys.folder / ROSTER, "key_file": keys.folder / SERVER_KEY}
            wiring |= {name: str(file) for name, file in files.items()}
        given = _beside(SERVER, fleet.federated_server.parameters, base)
        node = NodePlan(SERVER, "", wiring | given)
        plans.append(ProcessPlan(SERVER, (node,), first=True))
    views: dict[str, Value] = {
        "cameras": " ".join(camera.id for camera in cameras),
        "calibrations": " ".join(str(calibration_file(c, base, output)) for c in cameras),
        "image_sizes": " ".join("{}x{}".format(*image_size(camera)) for camera in cameras),
    }
    if fleet.twin and fleet.twin.enabled:
        wiring = {"network": str(base / fleet.twin.network)} | views | fleet.twin.parameters
        plans.append(ProcessPlan(TWIN, (NodePlan("sumo_bridge", "", wiring),), first=True))
    if fleet.carla and fleet.carla.enabled:
        carla = fleet.carla
        wiring = {"opendrive": str(base / carla.opendrive), "host": carla.host, "port": carla.port}
        bridge = NodePlan("carla_bridge", "", wiring | views | carla.parameters)
        plans.append(ProcessPlan(CARLA, (bridge,)))
    if fleet.viewer and fleet.viewer.enabled:
        where: dict[str, Value] = {"host": fleet.viewer.host, "port": fleet.viewer.port}
        plans.append(ProcessPlan(VIEWER, (NodePlan("viewer", "", where),), first=True))
    plans += [ProcessPlan(c.id, tuple(camera_nodes(c, fleet, base, output, keys))) for c in cameras]
    return tuple(plans)


def camera_nodes(
    camera: Camera, fleet: Fleet, base: Path, output: Path, keys: FederationKeys | None
) -> Iterable[NodePlan]:
    """The nodes of one camera, readers before writers: nothing is sent before it can be heard."""
    width, height = image_size(camera)
    size: dict[str, Value] = {"image_width": width, "image_height": height}
    seen = _calibration(camera, base, output)
    wiring: dict[str, dict[str, Value]] = {}
    if fleet.recorder and fleet.recorder.enabled:
        folder = output / fleet.recorder.folder
        wiring["recorder"] = {"database": str(folder / f"{camera.id}.db")}
    if fleet.traffic and fleet.traffic.enabled:
        wiring["traffic"] = seen | {"timezone": camera.timezone}
        wiring["traffic"] |= wiring.get("recorder", {}) | fleet.traffic.parameters
    state = output / "state" / camera.id
    wiring["lane_geometry"] = {"state_file": str(state / "lanes.npz")}
    if fleet.federated_server and fleet.federated_server.enabled:
        wiring["meta_client"] = {"state_file": str(state / "meta_client.npz")}
        if keys:
            wiring["meta_client"]["key_file"] = str(keys.folder / f"{camera.id}.key")
            wiring["meta_client"]["server_key"] = keys.server
            wiring["lane_geometry"]["lane_parameters_key"] = keys.cameras[camera.id]
    wiring["homography"] = seen | size
    if camera.datum:
        wiring["homography"]["datum_latitude_deg"] = camera.datum.latitude_deg
        wiring["homography"]["datum_longitude_deg"] = camera.datum.longitude_deg
    if camera.views:
        files = " ".join(f"{view.name}={base / view.calibration}" for view in camera.views)
        wiring["homography"]["view_calibrations"] = files
    if camera.kind == "bag":
        bag = str(base / camera.source.partition(":")[2])
        wiring["bag_player"] = {
            "bag": bag,
            "loop": camera.repeat,
            "exit_when_done": False,
            "camera_id": camera.id,
            "publish_clock": False,
            "stamp_now": True,
        }
    else:
        wiring["overlay"] = dict(seen)
        model = _model(camera, base)
        wiring["tracker"] = dict(size)
        wiring["detector"] = {"model": model}
        if camera.watch_view:
            wiring["view_watch"] = _view_watch(camera, base, state, seen["calibration_file"])
        wiring["camera"] = _images(camera, base)
    for executable, values in wiring.items():
        given = _beside(executable, camera.parameters.get(executable, {}), base)
        yield NodePlan(executable, camera.id, values | given)


def _images(camera: Camera, base: Path) -> dict[str, Value]:
    """Parameters of the node that reads a camera's images."""
    values: dict[str, Value] = {"source": image_source(camera, base)}
    if camera.password_file is not None:
        values["password_file"] = str(base / camera.password_file)
    if camera.password_variable is not None:
        values["password_variable"] = camera.password_variable
    if camera.kind != "stream":
        # One that plays once stays when it is done: its lanes are still asked for.
        values |= {"loop": camera.repeat, "start_time_s": 0.0, "exit_when_done": False}
    return values


def _view_watch(
    camera: Camera, base: Path, state: Path, calibration_file: Value
) -> dict[str, Value]:
    """Parameters of the node that holds a camera's images against its views."""
    return {
        "calibration_file": calibration_file,
        "state_file": str(state / "views.npz"),
        "view_images": " ".join(f"{view.name}={base / view.image}" for view in camera.views),
        "repeats_allowed": camera.kind != "stream" and camera.repeat,
    }


def plugin_kind(executable: str, parameter: str) -> str:
    """Kind of plug-in that a node's parameter takes; empty: none."""
    if (executable, parameter) == ("detector", "model"):  # which takes ONNX files, too
        return "detector"
    spec = spec_by_name(executable).get(parameter)
    return spec.plugin if spec is not None and spec.plugin in FROM_FILES else ""


def chosen_plugins(plans: Iterable[ProcessPlan]) -> Iterable[tuple[str, str, str]]:
    """Process with node, kind and name of every plug-in that the nodes of a fleet load."""
    for plan in plans:
        for node in plan.nodes:
            for name, value in node.parameters.items():
                kind = plugin_kind(node.executable, name)
                if kind and is_file(str(value)):
                    yield f"{plan.name}, node {node.executable}", kind, str(value)


def _beside(executable: str, given: Mapping[str, Value], base: Path) -> dict[str, Value]:
    """Parameters of a fleet file; plug-ins in them start at the fleet file's folder."""
    return {
        name: str(base / str(value))
        if plugin_kind(executable, name) and is_file(str(value))
        else value
        for name, value in given.items()
    }


def make_folders(fleet: Fleet, output: Path) -> None:
    """Make the folders that nodes write into but don't make themselves."""
    folders = [output / "state" / camera.id for camera in fleet.cameras if camera.enabled]
    if fleet.recorder and fleet.recorder.enabled:
        folders.append(output / fleet.recorder.folder)
    for folder in folders:
        folder.mkdir(parents=True, exist_ok=True)


def expected_nodes(fleet: Fleet) -> dict[str, list[str]]:
    """Executables that a running fleet shows, by camera id; `""` for those without a namespace."""
    plans = plan_nodes(fleet, Path(), Path())
    expected: dict[str, list[str]] = {}
    for plan in plans:
        for node in plan.nodes:
            expected.setdefault(node.namespace, []).append(node.executable)
    return expected


def image_size(camera: Camera) -> tuple[int, int]:
    """Width and height as far as they are known."""
    return camera.image_size or BAG_IMAGE_SIZE


def image_source(camera: Camera, base: Path) -> str:
    """What the camera node opens: local paths start at the fleet file's folder."""
    return str(base / local_path(camera.source)) if camera.kind == "file" else camera.source


def _calibration(camera: Camera, base: Path, output: Path) -> dict[str, Value]:
    """The parameters with which a node finds a camera's calibration."""
    found: dict[str, Value] = {"calibration_file": str(calibration_file(camera, base, output))}
    if camera.camera_info is not None:
        found["camera_info_file"] = str(base / camera.camera_info)
    return found


def calibration_file(camera: Camera, base: Path, output: Path) -> Path:
    """The camera's control points; a made-up camera's are written by `geoorbit up`."""
    if camera.calibration is None:
        return output / "calibration" / f"{camera.id}.csv"
    return base / camera.calibration


def select(plans: Sequence[ProcessPlan], only: Sequence[str]) -> tuple[ProcessPlan, ...]:
    """The processes of these names; all when there is none.

    Raises:
        FleetPlanError: A name that no process has.
    """
    known = [plan.name for plan in plans]
    for name in only:
        if name not in known:
            raise FleetPlanError("--only", f"'{name}'", f"one of {', '.join(known)}")
    return tuple(plan for plan in plans if not only or plan.name in only)


def _check_names(fleet: Fleet) -> None:
    for camera in fleet.cameras:
        if camera.id in RESERVED_NAMES:
            raise FleetPlanError("fleet, camera id", f"'{camera.id}'", "a name that no service has")


def _model(camera: Camera, base: Path) -> str:
    """The detector node's `model`: a registered name as it is, a file below `base`."""
    if camera.model is None or str(camera.model) in registered("detector"):
        return str(camera.model or "")
    return str(base / camera.model)


def _check_files(fleet: Fleet, base: Path) -> None:
    missing = missing_files(fleet, base)
    if missing:
        named = "; no ".join(f"{name}: {file}" for name, files in missing.items() for file in files)
        raise FleetPlanError("fleet files", f"no {named}", "files that exist")


def missing_files(fleet: Fleet, base: Path) -> dict[str, list[Path]]:
    """Files that the fleet names and that are not there, by camera or service.

    Args:
        fleet: The fleet.
        base: Folder that relative paths in the fleet file start from.
    """
    files: dict[str, list[Path]] = {}
    for camera in fleet.cameras:
        if not camera.enabled:
            continue
        named = (camera.calibration, camera.camera_info, camera.password_file)
        own = [file for file in named if file is not None]
        own += [file for view in camera.views for file in (view.calibration, view.image)]
        files[camera.id] = own
        if camera.model is not None and str(camera.model) not in registered("detector"):
            own.append(Path(plugin_file(str(camera.model))))
        if camera.kind == "bag":
            own.append(Path(camera.source.partition(":")[2]))
        elif camera.kind == "file":
            own.append(Path(local_path(camera.source)))
    if fleet.twin and fleet.twin.enabled:
        files[TWIN] = [fleet.twin.network]
    if fleet.carla and fleet.carla.enabled:
        files[CARLA] = [fleet.carla.opendrive]
    missing = {
        name: [base / masked(str(file)) for file in own if not (base / file).exists()]
        for name, own in files.items()
    }
    return {name: own for name, own in missing.items() if own}


def without(fleet: Fleet, names: Collection[str]) -> Fleet:
    """The fleet without some cameras and services; without its twin, CARLA shows nothing.

    Raises:
        FleetPlanError: No camera is left.
    """
    gone = {*names, *({CARLA} if TWIN in names else ())}
    cameras = [camera for camera in fleet.cameras if camera.id not in gone]
    if not cameras:
        raise FleetPlanError("fleet", "no camera that can be used", "one or more")
    changed: dict[str, object] = {"cameras": cameras}
    changed |= dict.fromkeys((name for name in SERVICES if name in gone), None)
    return fleet.model_copy(update=changed)
