"""A CARLA server through its own Python client (carla 0.9.16, an optional dependency).

`CarlaClient` is the server; `CarlaVehicles` keeps one actor there per vehicle of the twin.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.twin.carla.frame import CarlaCamera, CarlaPose, vehicle_pose


class CarlaError(GeoOrbitError):
    """CARLA's client is not there, or its server does not answer, or refuses something."""


BASE_TYPES = {2: ("car",), 3: ("motorcycle",), 5: ("bus", "van"), 7: ("truck", "van")}
"""Attribute `base_type` of CARLA's vehicles by COCO class; bicycles are `bicycle`."""
BICYCLE = 1
"""COCO class."""
OnImage = Callable[[str, float, NDArray[np.uint8]], None]


def import_carla() -> Any:
    """CARLA's client library.

    Raises:
        CarlaError: It is not installed.
    """
    try:
        import carla
    except ImportError as error:
        expected = 'pip install "geoorbit_ros[carla]" (Python 3.10 to 3.12)'
        raise CarlaError("CARLA", f"no client library ({error})", expected) from None
    return carla


def transform(carla: Any, pose: CarlaPose) -> Any:
    """A pose as `carla.Transform`."""
    return carla.Transform(
        carla.Location(x=pose.x, y=pose.y, z=pose.z),
        carla.Rotation(pitch=pose.pitch_deg, yaw=pose.yaw_deg, roll=pose.roll_deg),
    )


def pixels_of(raw: bytes, width: int, height: int) -> NDArray[np.uint8]:
    """(H, W, 3) blue, green, red of a `carla.Image`'s raw data, without its alpha channel."""
    return np.frombuffer(raw, np.uint8).reshape(height, width, 4)[:, :, :3].copy()


class CarlaClient:
    """Loads a road into a server and moves its actors, one server frame per step.

    Args:
        host: Where the server runs.
        port: Its port.
        timeout_s: Longest wait for an answer.
        opendrive: The road, OpenDRIVE text.
        step_s: Length of a frame of the server.
        carla: The library; default: the installed one.

    Raises:
        CarlaError: No library, no server, another version, or a road that it refuses.
    """

    def __init__(
        self,
        host: str,
        port: int,
        timeout_s: float,
        opendrive: str,
        step_s: float,
        carla: Any = None,
    ) -> None:
        self._carla = carla or import_carla()
        self._place = f"CARLA at {host}:{port}"
        self._sensors: list[Any] = []
        with self._watched(f"no server that answers in {timeout_s:g} s", "CarlaUE4.sh running"):
            self._client = self._carla.Client(host, port)
            self._client.set_timeout(timeout_s)
            server, own = (
                self._client.get_server_version(),
                self._client.get_client_version(),
            )
        if server != own:
            raise CarlaError(self._place, f"a server {server}", f"version {own}, the client's")
        with self._watched("a server that refuses the road", "an OpenDRIVE road it can load"):
            self._world = self._client.generate_opendrive_world(
                opendrive, self._carla.OpendriveGenerationParameters()
            )
            settings = self._world.get_settings()
            settings.synchronous_mode, settings.fixed_delta_seconds = True, step_s
            self._world.apply_settings(settings)
            self._blueprints = self._world.get_blueprint_library()

    def spawn(self, class_id: int, length_m: float, pose: CarlaPose) -> int | None:
        """Add a vehicle that only `move` moves; None where there is no room for it."""
        with self._watched():
            blueprint = self._vehicle(class_id)
            actor = self._world.try_spawn_actor(blueprint, transform(self._carla, pose))
            if actor is None:
                return None
            actor.set_simulate_physics(False)
            return int(actor.id)

    def move(self, poses: Mapping[int, CarlaPose]) -> None:
        """Set the poses of actors, all at once."""
        command = self._carla.command.ApplyTransform
        with self._watched():
            self._client.apply_batch_sync(
                [command(actor, transform(self._carla, pose)) for actor, pose in poses.items()]
            )

    def destroy(self, actors: Sequence[int]) -> None:
        """Remove actors."""
        with self._watched():
            self._client.apply_batch_sync(
                [self._carla.command.DestroyActor(actor) for actor in actors]
            )

    def tick(self) -> None:
        """Simulate one frame."""
        with self._watched():
            self._world.tick()

    def add_camera(self, camera: CarlaCamera, on_image: OnImage) -> None:
        """Add a roadside camera.

        `on_image` gets its name, the server's time and every image, in a thread of the client.
        """
        with self._watched():
            blueprint = self._blueprints.find("sensor.camera.rgb")
            for name, value in (
                ("image_size_x", camera.image_size[0]),
                ("image_size_y", camera.image_size[1]),
                ("fov", f"{camera.fov_deg:.4f}"),
            ):
                blueprint.set_attribute(name, str(value))
            sensor = self._world.spawn_actor(blueprint, transform(self._carla, camera.pose))
            sensor.listen(
                lambda image: on_image(
                    camera.name,
                    float(image.timestamp),
                    pixels_of(bytes(image.raw_data), image.width, image.height),
                )
            )
            self._sensors.append(sensor)

    def close(self) -> None:
        """Remove the cameras and let the server run on its own clock again."""
        with self._watched():
            for sensor in self._sensors:
                sensor.stop()
                sensor.destroy()
            settings = self._world.get_settings()
            settings.synchronous_mode, settings.fixed_delta_seconds = False, None
            self._world.apply_settings(settings)

    def _vehicle(self, class_id: int) -> Any:
        wanted = ("bicycle",) if class_id == BICYCLE else BASE_TYPES.get(class_id, ("car",))
        vehicles = list(self._blueprints.filter("vehicle.*"))
        for kind in wanted:
            for blueprint in vehicles:
                if (
                    blueprint.has_attribute("base_type")
                    and blueprint.get_attribute("base_type").as_str() == kind
                ):
                    return blueprint
        return vehicles[0]

    @contextmanager
    def _watched(
        self, found: str = "a server that is gone", expected: str = "a running one"
    ) -> Iterator[None]:
        try:
            yield
        except RuntimeError as error:  # all that the client raises
            text = " ".join(str(error).split())
            raise CarlaError(self._place, f"{found} ({text[:120]})", expected) from error


class CarlaServer(Protocol):
    """What `CarlaVehicles` needs of a server. All methods raise CarlaError when it is gone."""

    def spawn(self, class_id: int, length_m: float, pose: CarlaPose) -> int | None:
        """Add a vehicle that only `move` moves; None where there is no room for it."""

    def move(self, poses: Mapping[int, CarlaPose]) -> None:
        """Set the poses of actors, all at once."""

    def destroy(self, actors: Sequence[int]) -> None:
        """Remove actors."""

    def tick(self) -> None:
        """Simulate one frame."""


class CarlaVehicles:
    """Keeps one actor per vehicle of the twin.

    Args:
        server: Has the actors.

    Attributes:
        actors: Actor by vehicle id.
        refused: How often there was no room for a vehicle; each is tried again with every step.
    """

    def __init__(self, server: CarlaServer) -> None:
        self._server = server
        self.actors: dict[int, int] = {}
        self.refused = 0

    def update(self, rows: NDArray[np.void], origin_m: NDArray[np.float64]) -> None:
        """Follow one step of the twin.

        Args:
            rows: `TRACK_DTYPE` of `twin/tracks`.
            origin_m: (2,) origin of their frame in the road's.
        """
        there = set(rows["track_id"].tolist())
        gone = [vehicle for vehicle in self.actors if vehicle not in there]
        if gone:
            self._server.destroy([self.actors.pop(vehicle) for vehicle in gone])
        poses: dict[int, CarlaPose] = {}
        for row in rows:
            x, y = float(row["x"]) + origin_m[0], float(row["y"]) + origin_m[1]
            pose = vehicle_pose(x, y, float(row["heading"]))
            vehicle = int(row["track_id"])
            if vehicle in self.actors:
                poses[self.actors[vehicle]] = pose
                continue
            actor = self._server.spawn(int(row["class_id"]), float(row["length"]), pose)
            if actor is None:
                self.refused += 1
            else:
                self.actors[vehicle] = actor
        self._server.move(poses)
        self._server.tick()

    def close(self) -> None:
        """Remove all vehicles."""
        self._server.destroy(list(self.actors.values()))
        self.actors.clear()
