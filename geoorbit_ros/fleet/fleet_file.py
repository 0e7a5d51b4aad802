"""A fleet file: what it says about cameras and services, and how a camera is added to it."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import Field, model_validator

from geoorbit_ros.core.addresses import (
    MASK,
    check_address,
    is_address,
    masked,
    read_password,
    with_password,
)
from geoorbit_ros.core.errors import InputFileError, ParameterError
from geoorbit_ros.core.resources import share_path
from geoorbit_ros.parameters import ParameterSpec, load_schema, spec_by_name
from geoorbit_ros.storage.atomic import atomic_output
from geoorbit_ros.storage.yaml_file import StrictModel, WrongValue, read_yaml

FOLDER = "params/fleets"
MAX_CAMERAS = 1000
"""Chosen: each camera is a process of one host; more is taken for a mistake in the file."""

CAMERA_NODES = (
    *("bag_player", "camera", "detector", "tracker"),
    *("homography", "lane_geometry", "recorder", "meta_client", "overlay"),
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


class Camera(StrictModel):
    """One camera and what is done with its images.

    Attributes:
        id: Its namespace in the graph.
        source: A video file, `rtsp://…`, `http://…`, a folder of images, `scene:NAME` for a
            made-up camera, or `bag:FOLDER` for recorded boxes.
        calibration: Control points, a CSV file. A `scene:` camera brings its own.
        password_file: File with the camera's password, in place of one in `source`, which then
            names the user alone: `rtsp://admin@camera/1`.
        password_variable: Environment variable with it.
        model: ONNX file of a detector, or `FILE.py:CLASS`; none: moving objects are detected.
        image_size: Width and height in pixels; files and scenes tell it themselves, for a stream it
            must be given, for a bag it is 1920 x 1080 unless given.
        datum: Origin of its map; default: the middle of its control points.
        position: Where it stands, for maps.
        repeat: Whether a recording starts again at its end.
        enabled: Whether it is started.
        parameters: Values that go before the nodes' defaults.
    """

    id: Identifier
    source: str = Field(min_length=1)
    password_file: Path | None = None
    password_variable: str | None = None
    calibration: Path | None = None
    model: Path | None = None
    image_size: tuple[Pixels, Pixels] | None = None
    datum: Position | None = None
    position: Position | None = None
    repeat: bool = True
    enabled: bool = True
    parameters: Overrides = Field(default={})

    @property
    def kind(self) -> str:
        """`bag`, `scene`, `stream` or `file`."""
        if is_address(self.source):
            return "stream"
        start = re.match(r"(bag|scene)(:|$)", self.source)
        return "file" if start is None else start[1]

    @model_validator(mode="after")
    def _complete(self) -> Camera:
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
        check_overrides(self.parameters, CAMERA_NODES)
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
    def _known(self) -> FederatedServer:
        check_parameters(self.parameters, "federated_server")
        return self


class Twin(Service):
    """The SUMO twin.

    Attributes:
        network: A SUMO network (`.net.xml`).
    """

    network: Path
    parameters: dict[str, Value] = _parameters_of("sumo_bridge")

    @model_validator(mode="after")
    def _known(self) -> Twin:
        check_parameters(self.parameters, "sumo_bridge")
        return self


class Carla(Service):
    """The twin's vehicles in a CARLA server, and what the cameras would see there; needs a twin.

    Attributes:
        opendrive: The road, an OpenDRIVE file of the twin's network.
        host: Where the server runs.
        port: Its port.
    """

    opendrive: Path
    host: str = "localhost"
    port: int = Field(default=2000, ge=1, le=65535)
    parameters: dict[str, Value] = _parameters_of("carla_bridge")

    @model_validator(mode="after")
    def _known(self) -> Carla:
        check_parameters(self.parameters, "carla_bridge")
        return self


class Recorder(StrictModel):
    """Trajectories and lanes of every camera, one database each.

    Attributes:
        folder: Where `<camera>.db` lie; relative to the fleet's output folder.
    """

    enabled: bool = True
    folder: Path = Path("recordings")


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


def node_parameters(node: str) -> tuple[ParameterSpec, ...]:
    """The parameters of a node that a fleet file can name.

    Raises:
        ParameterError: No such node.
    """
    if node not in NODES:
        raise ParameterError("node", f"'{node}'", f"one of {', '.join(NODES)}")
    return load_schema(node)


def check_overrides(overrides: Mapping[str, Mapping[str, Value]], nodes: tuple[str, ...]) -> None:
    """Check parameters by node against the nodes' schemas.

    Raises:
        WrongValue: No such node or parameter, or a value that the parameter can't have.
    """
    for node, values in overrides.items():
        if node not in nodes:
            raise WrongValue(("parameters", node), "an unknown node", f"one of {', '.join(nodes)}")
        check_parameters(values, node, ("parameters", node))


def check_parameters(
    values: Mapping[str, Value], node: str, key: tuple[str, ...] = ("parameters",)
) -> None:
    """Check one node's parameters.

    Raises:
        WrongValue: No such parameter, or a value that it can't have.
    """
    specs = spec_by_name(node) if values else {}
    for name, value in values.items():
        if name not in specs:
            known = ", ".join(sorted(specs))
            raise WrongValue((*key, name), "an unknown parameter", f"one of {known}")
        try:
            specs[name].checked(value, node)
        except ParameterError as error:
            raise WrongValue((*key, name), error.found, error.expected) from error


def shipped_fleets() -> list[str]:
    """Names of the fleets that come with the package."""
    return sorted(file.stem for file in share_path(FOLDER).glob("*.yaml"))


def load_fleet(path: str | Path) -> tuple[Fleet, Path]:
    """Read a fleet file, or a shipped fleet by its bare name.

    Returns:
        The fleet, and the file it was read from: its relative paths start there.

    Raises:
        InputFileError: No such file, or a value that a fleet can't have, with its line and key.
    """
    file = Path(path)
    if not file.suffix and str(path) == file.name and not file.is_file():
        if file.name not in shipped_fleets():
            expected = f"a file, or one of {', '.join(shipped_fleets())}"
            raise InputFileError(f"fleet '{path}'", "no such fleet", expected)
        file = share_path(f"{FOLDER}/{path}.yaml")
    return read_yaml(file, Fleet, "fleet"), file


def add_camera(file: Path, entry: Mapping[str, object], *, replace: bool = False) -> Fleet:
    """Add an entry after the last camera of a fleet file, or write a new file.

    Comments and order of the file stay. The result is read back before it replaces the file. A new
    fleet is named after its file.

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
        text = file.read_text(encoding="utf-8").rstrip("\n") + "\n"
        known = camera_id in [camera.id for camera in load_fleet(file)[0].cameras]
        text = _exchanged(text, camera_id, entry) if known else _inserted(text, entry)
    else:
        text = f"name: {_fleet_name(file)}\ncameras:\n{_item(entry, '  ')}"
    with atomic_output(file) as path:
        path.write_text(text, encoding="utf-8")
        return load_fleet(path)[0]


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
    text = _exchanged(file.read_text(encoding="utf-8").rstrip("\n") + "\n", camera_id, None)
    with atomic_output(file) as path:
        path.write_text(text, encoding="utf-8")
        return load_fleet(path)[0]


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


def relative(path: Path, file: Path) -> str:
    """A path as a fleet file names it."""
    return os.path.relpath(path.absolute(), file.absolute().parent)


def _fleet_name(file: Path) -> str:
    """A file's name as a name that ROS 2 takes."""
    name = re.sub(r"\W", "_", file.stem, flags=re.ASCII)
    return name if re.match(IDENTIFIER, name) else f"fleet_{name}"


def _inserted(text: str, entry: Mapping[str, object]) -> str:
    """The file's text with another camera after the last one."""
    cameras, lines = _cameras(text)
    end = _span(cameras.value[-1], lines)[1]
    indent = " " * cameras.start_mark.column
    return "".join([*lines[:end], _item(entry, indent), *lines[end:]])


def _exchanged(text: str, camera_id: str, entry: Mapping[str, object] | None) -> str:
    """The file's text with another entry in the place of a camera, or with nothing there."""
    cameras, lines = _cameras(text)
    item = next(node for node in cameras.value if camera_id == _id_of(node))
    start, end = _span(item, lines)
    indent = " " * cameras.start_mark.column
    new = [] if entry is None else [_item(entry, indent)]
    return "".join([*lines[:start], *new, *lines[end:]])


def _cameras(text: str) -> tuple[yaml.SequenceNode, list[str]]:
    """The list of cameras in a fleet file's text, and the text's lines."""
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    assert isinstance(root, yaml.MappingNode)  # it was read as a fleet
    cameras = next(value for key, value in root.value if key.value == "cameras")
    if cameras.flow_style:
        raise InputFileError(
            "fleet file, key 'cameras'", "a list in brackets", "one camera per '-'"
        )
    return cameras, text.splitlines(keepends=True)


def _id_of(camera: yaml.MappingNode) -> str:
    return next((str(value.value) for key, value in camera.value if key.value == "id"), "")


def _span(camera: yaml.MappingNode, lines: list[str]) -> tuple[int, int]:
    """First line of a camera's entry and the one after its last, comments behind it left out."""
    start = camera.start_mark.line
    end = camera.end_mark.line + int(bool(camera.flow_style))
    while end > start and not lines[end - 1].strip(" \n").partition("#")[0].strip():
        end -= 1  # comments and empty lines that follow belong to what comes next
    return start, end


def _item(entry: Mapping[str, object], indent: str) -> str:
    body = yaml.safe_dump(dict(entry), sort_keys=False, allow_unicode=True, default_flow_style=None)
    first, *rest = body.splitlines()
    return "".join([f"{indent}- {first}\n", *(f"{indent}  {line}\n" for line in rest)])
