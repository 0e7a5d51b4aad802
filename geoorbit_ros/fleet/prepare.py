"""All that must be there before a fleet's processes start."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from geoorbit_ros.fleet.federation_keys import federation_keys
from geoorbit_ros.fleet.fleet_file import Fleet
from geoorbit_ros.fleet.plan import ProcessPlan, make_folders, plan_fleet, select
from geoorbit_ros.fleet.sources import ask_sources


def prepare(
    fleet: Fleet, base: Path, output: Path, only: Sequence[str] = ()
) -> tuple[ProcessPlan, ...]:
    """Look at the sources, make folders and keys, and return the plan to run.

    Args:
        fleet: The fleet.
        base: Folder that relative paths in the fleet file start from.
        output: Folder of logs, recordings and state.
        only: Names of the processes to run; none: all.

    Raises:
        GeoOrbitError: A file, source or key that can't be used.
    """
    chosen = {plan.name for plan in select(plan_fleet(fleet, base, output), only)}
    fleet = ask_sources(fleet, base, output, chosen)
    make_folders(fleet, output)
    keys = None
    if fleet.federated_server and fleet.federated_server.enabled:
        names = [camera.id for camera in fleet.cameras if camera.enabled]
        keys = federation_keys(output / "keys", names)
    return select(plan_fleet(fleet, base, output, keys), only)
