"""A fleet file: what it says about cameras and services."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from pydantic import BeforeValidator, Field, ValidationInfo, model_validator

from geoorbit_ros.core.addresses import (
    MASK,
    check_address,
    is_address,
    masked,
    read_password,
    with_password,
)
from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.core.input_report import InputReport, Treatment
from geoorbit_ros.parameters import ParameterSpec, load_schema, nearest, spec_by_name
from geoorbit_ros.storage.yaml_file import StrictModel, WrongValue, spell

MAX_CAMERAS = 1000
"""Chosen: each camera is a process of one host; more is taken for a mistake in the file."""

CAMERA_NODES = (
    *("bag_player", "camera", "view_watch", "detector", "tracker"),
    *("homography", "lane_geometry", "recorder", "traffic", "meta_client", "overlay"),
)
"""Nodes in a camera's namespace, in the order in which data goes through them."""
NODES = (*CAMERA_NODES, "federated_server", "sumo_bridge", "carla_bridge")
"""Nodes whose parameters a fleet file can set: those of cameras, then those of services."""


def _node_schema(node: str) -> dict[str, Any]:
    """JSON schema of one node's parameters, for editors."""
    properties = {spec.name: spec.json_schema() for spec in load_schema(node)}
    return {"type": "object", "properties": properties, "additionalProperties": False}


def _parameters_of(node: str) -> Any:
    """A field for one node's parameters."""
    return Field(default={}, json_schema_extra=lambda schema: schema.update(_node_schema(node)))


def _add_overrides(schema: dict[str, Any]) -> None:
    schema.pop("additionalProperties", None)
    nodes = {node: _node_schema(node) for node in CAMERA_NODES}
    schema |= {"properties": nodes, "additionalProperties": False}


def _expanded(value: object) -> object:
    """A path or source with `~` and environment variables replaced; addresses stay as they are."""
    if not isinstance(value, str) or is_address(value):
        return value
    scheme, colon, path = value.partition(":")
    if scheme == "bag" and colon:
        return f"bag:{os.path.expanduser(os.path.expandvars(path))}"
    return os.path.expanduser(os.path.expandvars(value))


FilePath = Annotated[Path, BeforeValidator(_expanded)]
"""A path; relative ones start at the fleet file."""
IDENTIFIER = r"^[A-Za-z][A-Za-z0-9_]*$"
"""What ROS 2 takes in a namespace (REP-144 for names, design article on topic names)."""
Identifier = Annotated[str, Field(pattern=IDENTIFIER)]
"""What a ROS namespace can be called."""
Value = bool | int | float | str
Overrides = Annotated[
    dict[str, dict[str, Value]],
    Field(
        description="Parameters by node; `geoorbit fleet parameters` lists them.",
        json_schema_extra=_add_overrides,
    ),
]
Pixels = Annotated[int, Field(ge=16, le=16384)]


class Position(StrictModel):
    """A point on earth (WGS 84)."""

    latitude_deg: float = Field(ge=-90.0, le=90.0)
    longitude_deg: float = Field(ge=-180.0, le=180.0)


class View(StrictModel):
    """A preset of a PTZ camera beside its first one, which has a calibration of its own.

    Attributes:
        name: Of the preset.
        calibration: Its control points, a CSV file.
        image: A picture of the view, in the size of the camera's images.
    """

    name: Identifier
    calibration: FilePath
    image: FilePath


class Camera(StrictModel):
    """One camera and what is done with its images.

    Attributes:
        id: Its namespace in the graph.
        source: A video file, `rtsp://…`, `http://…`, a folder of images, `scene:NAME` for a
            made-up camera, or `bag:FOLDER` for recorded boxes.
        calibration: Control points, a CSV file. A `scene:` camera brings its own.
        camera_info: Its lens: camera_info in YAML, as ROS' camera_calibration writes it; default:
            as the control points' file says.
        password_file: File with the camera's password, in place of one in `source`, which then
            names the user alone: `rtsp://admin@camera/1`.
        password_variable: Environment variable with it.
        model: ONNX file of a detector, or `FILE.py:CLASS`; none: moving objects are detected.
        image_size: Width and height in pixels; files and scenes tell it themselves, for a stream it
            must be given, for a bag it is 1920 x 1080 unless given.
        datum: Origin of its map; default: the middle of its control points.
        position: Where it stands, for maps.
        timezone: IANA name of the time zone on whose clock its traffic is counted.
        repeat: Whether a recording starts again at its end.
        enabled: Whether it is started.
        watch_view: Whether its images are held against a reference view, so that a move is told.
        views: Presets of a PTZ camera beside the one of `calibration`.
        parameters: Values that go before the nodes' defaults.
    """

    id: Identifier
    source: Annotated[str, BeforeValidator(_expanded)] = Field(min_length=1)
    password_file: FilePath | None = None
    password_variable: str | None = None
    calibration: FilePath | None = None
    camera_info: FilePath | None = None
    model: FilePath | None = None
    image_size: tuple[Pixels, Pixels] | None = None
    datum: Position | None = None
    position: Position | None = None
    timezone: str = "UTC"
    repeat: bool = True
    enabled: bool = True
    watch_view: bool = True
    views: list[View] = Field(default=[])
    parameters: Overrides = Field(default={})

    @property
    def kind(self) -> str:
        """`bag`, `scene`, `stream` or `file`."""
        if is_address(self.source):
            return "stream"
        start = re.match(r"(bag|scene)(:|$)", self.source)
        return "file" if start is None else start[1]

    @model_validator(mode="after")
    def _complete(self, info: ValidationInfo) -> Camera:
        if self.kind in ("bag", "scene") and not self.source.partition(":")[2]:
            wanted = "bag:FOLDER" if self.kind == "bag" else "scene:NAME"
            raise WrongValue(("source",), repr(self.source), wanted)
        if self.kind == "stream":
            self._check_address()
        elif self.password_file or self.password_variable:
            raise WrongValue(("source",), f"'{self.source}'", "an address, which has a password")
        if self.kind != "scene" and self.calibration is None:
            raise WrongValue(("calibration",), "nothing", "a CSV file of control points")
        if self.kind == "stream" and self.image_size is None:
            raise WrongValue(("image_size",), "nothing", "[width, height] of the stream's images")
        if self.kind == "bag" and self.model is not None:
            found = f"'{self.model}' beside recorded boxes"
            raise WrongValue(("model",), found, "no model, or a source with images")
        try:
            ZoneInfo(self.timezone)
        except (ZoneInfoNotFoundError, ValueError, OSError):
            wanted = "a name such as Europe/Berlin"
            raise WrongValue(("timezone",), f"'{self.timezone}'", wanted) from None
        check_overrides(self.parameters, CAMERA_NODES, info.context)
        return self

    def _check_address(self) -> None:
        sample = self.source
        try:
            if self.password_file and self.password_variable:
                names = "password_file and password_variable"
                raise ParameterError("", names, "one of them")
            if self.password_file or self.password_variable:
                places = max(self.source.count(MASK), 1)
                sample = with_password(self.source, "\n".join(["password"] * places), "")
            check_address(sample)
        except ParameterError as error:
            found = f"{error.found} (camera {self.id}, {masked(self.source)})"
            raise WrongValue(("source",), found, error.expected) from None

    def address(self, base: Path) -> str:
        """`source` with its password, wherever that is.

        Args:
            base: Folder that `password_file` starts from.

        Raises:
            ParameterError: There is no password where it should be.
        """
        place = f"camera {self.id}, password"
        if self.password_file is not None:
            password = read_password(base / self.password_file, place)
        elif self.password_variable is not None:
            password = os.environ.get(self.password_variable, "")
            if not password:
                found = f"no environment variable {self.password_variable}"
                raise ParameterError(place, found, "one with the password")
        else:
            return self.source
        return with_password(self.source, password, place)


class Service(StrictModel):
    """A part of the fleet with a process of its own."""

    enabled: bool = True
    parameters: dict[str, Value] = Field(default={})


class FederatedServer(Service):
    """The server that the cameras learn through; each camera then runs a `meta_client`."""

    parameters: dict[str, Value] = _parameters_of("federated_server")

    @model_validator(mode="after")
    def _known(self, info: ValidationInfo) -> FederatedServer:
        check_parameters(self.parameters, "federated_server", report=info.context)
        return self


class Twin(Service):
    """The SUMO twin.

    Attributes:
        network: A SUMO network (`.net.xml`).
    """

    network: FilePath
    parameters: dict[str, Value] = _parameters_of("sumo_bridge")

    @model_validator(mode="after")
    def _known(self, info: ValidationInfo) -> Twin:
        check_parameters(self.parameters, "sumo_bridge", report=info.context)
        return self


class Carla(Service):
    """The twin's vehicles in a CARLA server, and what the cameras would see there; needs a twin.

    Attributes:
        opendrive: The road, an OpenDRIVE file of the twin's network.
        host: Where the server runs.
        port: Its port.
    """

    opendrive: FilePath
    host: str = "localhost"
    port: int = Field(default=2000, ge=1, le=65535)
    parameters: dict[str, Value] = _parameters_of("carla_bridge")

    @model_validator(mode="after")
    def _known(self, info: ValidationInfo) -> Carla:
        check_parameters(self.parameters, "carla_bridge", report=info.context)
        return self


class Recorder(StrictModel):
    """Trajectories and lanes of every camera, one database each.

    Attributes:
        folder: Where `<camera>.db` lie; relative to the fleet's output folder.
    """

    enabled: bool = True
    folder: FilePath = Path("recordings")


class Traffic(StrictModel):
    """Vehicles per lane and interval of every camera, stored in its database if there is one.

    Attributes:
        parameters: Values that go before the defaults of the node `traffic`.
    """

    enabled: bool = True
    parameters: dict[str, Value] = _parameters_of("traffic")

    @model_validator(mode="after")
    def _known(self, info: ValidationInfo) -> Traffic:
        check_parameters(self.parameters, "traffic", report=info.context)
        return self


class Viewer(StrictModel):
    """A server for viewers that speak Foxglove's protocol."""

    enabled: bool = True
    host: str = "127.0.0.1"
    port: int = Field(default=8765, ge=1, le=65535)


class Fleet(StrictModel):
    """Cameras, and what they share.

    Attributes:
        name: Of the fleet; its output folder is called so unless one is given.
        description: One sentence for people.
        domain_id: ROS domain; default: the environment's ROS_DOMAIN_ID, else 0.
        cameras: At least one.
        federated_server: Where the cameras learn together; none: they don't.
        twin: None: no twin.
        carla: None: not in CARLA.
        recorder: None: nothing is recorded.
        traffic: None: no vehicles are counted.
        viewer: None: started by hand with `geoorbit view`.
    """

    name: Identifier
    description: str = ""
    domain_id: int | None = Field(default=None, ge=0, le=232)
    cameras: list[Camera] = Field(min_length=1, max_length=MAX_CAMERAS)
    federated_server: FederatedServer | None = None
    twin: Twin | None = None
    carla: Carla | None = None
    recorder: Recorder | None = None
    traffic: Traffic | None = None
    viewer: Viewer | None = None

    @model_validator(mode="after")
    def _unique(self) -> Fleet:
        first: dict[str, int] = {}
        for k, camera in enumerate(self.cameras):
            if camera.id in first:
                key = ("cameras", k, "id")
                raise WrongValue(key, f"'{camera.id}' again", "another id for each camera")
            first[camera.id] = k
        if self.carla and self.carla.enabled and not (self.twin and self.twin.enabled):
            raise WrongValue(("carla",), "no twin beside it", "a twin, whose vehicles CARLA shows")
        return self


SERVICE_MODELS: dict[str, type[StrictModel]] = {
    "federated_server": FederatedServer,
    "twin": Twin,
    "carla": Carla,
    "recorder": Recorder,
    "traffic": Traffic,
    "viewer": Viewer,
}
"""What cameras share, by the file's keys."""
SERVER_KEY_NAME = "server"
"""Name of the federated server's key file."""
RESERVED_NAMES = (*SERVICE_MODELS, SERVER_KEY_NAME)
"""No camera may be called so: its process, its section or its key would be another's."""


def node_parameters(node: str) -> tuple[ParameterSpec, ...]:
    """The parameters of a node that a fleet file can name.

    Raises:
        ParameterError: No such node.
    """
    if node not in NODES:
        raise ParameterError("node", f"'{node}'", f"one of {', '.join(NODES)}")
    return load_schema(node)


def check_overrides(
    overrides: Mapping[str, dict[str, Value]],
    nodes: tuple[str, ...],
    report: InputReport | None = None,
) -> None:
    """Check parameters by node against the nodes' schemas, and give them their types.

    Raises:
        WrongValue: No such node or parameter, or a value that the parameter can't have.
    """
    for node, values in overrides.items():
        if node not in nodes:
            raise WrongValue(("parameters", node), "an unknown node", nearest(node, nodes))
        check_parameters(values, node, ("parameters", node), report)


def check_parameters(
    values: dict[str, Value],
    node: str,
    key: tuple[str, ...] = ("parameters",),
    report: InputReport | None = None,
) -> None:
    """Check one node's parameters, and give them their types.

    Args:
        values: By name; changed in place where a value is written in another way than its type.
        node: The node.
        key: Where they stand in the file.
        report: Takes what is not written as its type.

    Raises:
        WrongValue: No such parameter, or a value that it can't have.
    """
    specs = spec_by_name(node) if values else {}
    for name, value in values.items():
        if name not in specs:
            known = [spec.name for spec in load_schema(node)]
            raise WrongValue((*key, name), "an unknown parameter", nearest(name, known))
        try:
            checked = specs[name].checked(value, node)
        except ParameterError as error:
            raise WrongValue((*key, name), error.found, error.expected) from error
        if report is not None and isinstance(value, str) and checked != value:
            text = f"{spell((*key, name))}: {value!r} is read as {checked}"
            report.note(Treatment.REPAIRED, text)
        values[name] = checked
