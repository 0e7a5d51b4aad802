"""The twin's vehicles in every step as a CSV file."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import IO

import numpy as np

from geoorbit_ros.roadnet.network import NONE, RoadNetwork
from geoorbit_ros.twin.placement import TwinStep
from geoorbit_ros.twin.vehicle_types import TYPES

COLUMNS = "time_s,vehicle,type,latitude,longitude,heading_deg,speed_mps,length_m,lane,observed"


class StateWriter:
    """Writes `COLUMNS`; a context manager.

    Time is the tracks' own; positions are the middle of the footprint; headings are clockwise
    from north; `lane` is SUMO's id, empty beside the network; `observed` is 0 where no camera saw
    the vehicle and it went on by itself.

    Args:
        path: The file.
        network: Names the lanes, and says where on earth they are.
    """

    def __init__(self, path: Path, network: RoadNetwork) -> None:
        self._path, self._network = path, network
        self._file: IO[str] | None = None

    def __enter__(self) -> StateWriter:
        self._file = self._path.open("w", encoding="utf-8")
        self._file.write(COLUMNS + "\n")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._file is not None:
            self._file.close()

    def write(self, step: TwinStep) -> None:
        """Write the vehicles of one step."""
        assert self._file is not None, "use it in a with statement"
        kept = np.isfinite(step.xy[:, 0])
        geodetic = self._network.datum.to_geodetic(step.xy[kept])
        heading = np.degrees(0.5 * np.pi - step.heading_rad[kept]) % 360.0
        speed = np.hypot(*step.velocity[kept].T)
        for vehicle, kind, (lat, lon), course, mps, length, lane, seen in zip(
            step.vehicle_id[kept].tolist(),
            step.kind[kept].tolist(),
            geodetic.tolist(),
            heading.tolist(),
            speed.tolist(),
            step.size_m[kept, 0].tolist(),
            step.lane[kept].tolist(),
            step.observed[kept].tolist(),
            strict=True,
        ):
            name = self._network.lane_id[lane] if lane != NONE else ""
            self._file.write(
                f"{step.stamp_ns / 1e9:.3f},{vehicle},{TYPES[kind].name},{lat:.8f},{lon:.8f},"
                f"{course:.2f},{mps:.2f},{length:.1f},{name},{int(seen)}\n"
            )
