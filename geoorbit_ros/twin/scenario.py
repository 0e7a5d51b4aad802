"""What if: lanes closed and speed limits set, on the running twin and in a forecast."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.roadnet.network import RoadNetwork

KMH_BOUNDS = (1.0, 250.0)


@dataclass(frozen=True, slots=True)
class Scenario:
    """How the road differs from the network.

    Attributes:
        closed: SUMO ids of the lanes that nobody may use.
        limit_mps: Speed limits by SUMO's lane id.
    """

    closed: frozenset[str] = frozenset()
    limit_mps: Mapping[str, float] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.closed or self.limit_mps)

    def words(self) -> str:
        """In one line."""
        limits = [f"{lane} {3.6 * v:.0f} km/h" for lane, v in sorted(self.limit_mps.items())]
        return "; ".join([f"{lane} closed" for lane in sorted(self.closed)] + limits) or "as it is"


def parse_scenario(
    closed: Iterable[str], limits: Iterable[str], network: RoadNetwork, place: str
) -> Scenario:
    """A scenario from words.

    Args:
        closed: Lanes (`east_0`) or whole edges (`east`) by SUMO's ids.
        limits: `<lane or edge>=<km/h>`; of two for a lane, the later counts.
        network: Whose ids they are.
        place: Where the words are from, for errors.

    Raises:
        ParameterError: An id that the network has not, or no speed.
    """
    shut = {lane for name in closed for lane in _lanes(name, network, place)}
    speed: dict[str, float] = {}
    for word in limits:
        name, _, text = word.rpartition("=")
        try:
            kmh = float(text)
        except ValueError:
            kmh = float("nan")
        if not name or not KMH_BOUNDS[0] <= kmh <= KMH_BOUNDS[1]:
            expected = f"<lane or edge>=<km/h from {KMH_BOUNDS[0]:g} to {KMH_BOUNDS[1]:g}>"
            raise ParameterError(place, f"'{word}'", expected)
        speed |= dict.fromkeys(_lanes(name, network, place), kmh / 3.6)
    return Scenario(frozenset(shut), speed)


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
