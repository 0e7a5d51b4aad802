"""A scenario: closed lanes and changed speed limits, for the running twin and for forecasts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.roadnet.network import RoadNetwork

KMH_BOUNDS = (1.0, 250.0)
"""Speed limits that are taken. Chosen: 0 would close the lane, and more is a slip of the key or
m/s."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """How the road differs from the network.

    Attributes:
        closed: SUMO's ids of the closed lanes.
        limit_mps: Speed limits by SUMO's lane id.
    """

    closed: frozenset[str] = frozenset()
    limit_mps: Mapping[str, float] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.closed or self.limit_mps)

    def describe(self) -> str:
        """The changes in one line."""
        limits = [f"{lane} {3.6 * v:.0f} km/h" for lane, v in sorted(self.limit_mps.items())]
        return "; ".join([f"{lane} closed" for lane in sorted(self.closed)] + limits) or "as it is"


def parse_scenario(
    closed: Iterable[str], limits: Iterable[str], network: RoadNetwork, place: str
) -> Scenario:
    """Read a scenario from texts.

    Args:
        closed: Lanes (`east_0`) or whole edges (`east`) by SUMO's ids.
        limits: `<lane or edge>=<km/h>`; of two for a lane, the later counts.
        network: Whose ids they are.
        place: Where the texts are from, for errors.

    Raises:
        ParameterError: An id that the network does not have, or no speed.
    """
    closed_lanes = {lane for name in closed for lane in _lanes(name, network, place)}
    speed: dict[str, float] = {}
    for text in limits:
        name, _, speed_text = text.rpartition("=")
        try:
            kmh = float(speed_text)
        except ValueError:
            kmh = float("nan")
        if not name or not KMH_BOUNDS[0] <= kmh <= KMH_BOUNDS[1]:
            expected = f"<lane or edge>=<km/h from {KMH_BOUNDS[0]:g} to {KMH_BOUNDS[1]:g}>"
            raise ParameterError(place, f"'{text}'", expected)
        speed |= dict.fromkeys(_lanes(name, network, place), kmh / 3.6)
    return Scenario(frozenset(closed_lanes), speed)


def _lanes(name: str, network: RoadNetwork, place: str) -> list[str]:
    found = [
        lane
        for lane, edge, internal in zip(
            network.lane_id, network.edge_id, network.internal.tolist(), strict=True
        )
        if name in (lane, edge) and not internal
    ]
    if not found:
        some = ", ".join(
            lane
            for lane, internal in zip(network.lane_id, network.internal.tolist(), strict=True)
            if not internal
        )
        known = some if len(some) < 120 else f"{some[:120]} …"
        raise ParameterError(place, f"'{name}'", f"a lane or an edge of the network: {known}")
    return found
