"""What the nodes of a fleet say on /diagnostics, as rows for people and scripts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

STALE_S = 5.0
"""A node that said nothing for this long is counted as silent. Nodes report every second; chosen:
larger, a node that hangs is shown later; smaller, a busy machine looks silent."""


@dataclass(frozen=True, slots=True)
class NodeReport:
    """The last status of one node.

    Attributes:
        name: Full name, `/north/tracker`.
        ok: Whether it found no fault in itself.
        message: Its sentence.
        values: Its counters and gauges, as text.
        age_s: Time since it came.
    """

    name: str
    ok: bool
    message: str
    values: Mapping[str, str]
    age_s: float

    @property
    def executable(self) -> str:
        """The last part of the name."""
        return self.name.rpartition("/")[2]

    @property
    def camera_id(self) -> str:
        """The namespace, without slashes at its ends."""
        return self.name.rpartition("/")[0].strip("/")


@dataclass(frozen=True, slots=True)
class Column:
    """A value of a camera's row.

    Attributes:
        key: In JSON.
        title: In the table; empty: in JSON only.
        sources: Node and value to take it from; the first that is there counts.
        summed: Whether all of them are added up instead.
    """

    key: str
    title: str
    sources: tuple[tuple[str, str], ...]
    summed: bool = False


_DATA_PATH = ("lane_geometry", "homography", "tracker", "detector", "camera", "bag_player")

_LOSSES = ("dropped", "missing", "refused")
MAX_LOST_SHARE = 0.05
"""Of the frames; above it the number is shown in another colour. Chosen: lanes take no harm from
single frames; a twentieth is more than a busy machine loses."""

COLUMNS = (
    Column(
        "rate_hz",
        "fps",
        (("homography", "rate_hz"), ("tracker", "rate_hz"), ("camera", "rate_hz")),
    ),
    Column("latency_ms", "p99 ms", (("homography", "age_ms_p99"), ("tracker", "age_ms_p99"))),
    Column("lanes_latency_ms", "", (("lane_geometry", "age_ms_p99"),)),
    Column("lost", "lost", ()),
    Column("lost_share", "", ()),
    *(Column(key, "", tuple((n, key) for n in _DATA_PATH), summed=True) for key in _LOSSES),
    Column("vehicles", "vehicles", (("homography", "vehicles"), ("tracker", "tracks_alive"))),
    Column("lanes_confirmed", "lanes", (("lane_geometry", "lanes_confirmed"),)),
    Column("lanes_tentative", "tent.", (("lane_geometry", "lanes_tentative"),)),
    Column("view", "view", (("view_watch", "state"),)),
    Column("view_event", "", (("view_watch", "last_event"),)),
    Column("view_moved_px", "", (("view_watch", "moved_px"),)),
    Column("parameters", "θ", (("lane_geometry", "parameter_version"),)),
    Column("round", "round", (("meta_client", "round"),)),
)

SERVICE_COLUMNS: Mapping[str, tuple[tuple[str, str], ...]] = {
    "federated_server": (
        ("{}", "progress"),
        ("{} clients answered", "answers"),
        ("loss {}", "loss"),
    ),
    "sumo_bridge": (
        ("{} vehicles", "vehicles"),
        ("error {} m (95 %)", "error_m_p95"),
        ("in another lane {}", "other_lane_share"),
        ("latency {} ms (99 %)", "latency_ms_p99"),
        ("{} findings on the map", "map_findings"),
    ),
    "carla_bridge": (("{} vehicles", "vehicles"), ("{} images", "images")),
    "viewer": (("port {}", "port"), ("{} topics offered", "topics"), ("{} looked at", "read")),
}
"""What people want to know of a service, as words with the value at `{}`."""


@dataclass(frozen=True, slots=True)
class Row:
    """One camera, or one service of the fleet.

    Attributes:
        name: Camera id, or the node's name for one without namespace.
        healthy: Every node spoke within `STALE_S` and none found a fault.
        nodes: How many nodes of it were heard.
        problems: Sentences, with the node in front.
        values: By column key (a camera) or by the node's own keys (a service).
    """

    name: str
    healthy: bool
    nodes: int
    problems: tuple[str, ...]
    values: Mapping[str, str] = field(default_factory=dict)

    @property
    def words(self) -> str:
        """A service's values as a sentence for people; all of them for one that isn't known."""
        columns = SERVICE_COLUMNS.get(self.name, [(f"{key} {{}}", key) for key in self.values])
        return ", ".join(
            text.format(self.values[key]) for text, key in columns if self.values.get(key)
        )


def rows(
    reports: Iterable[NodeReport], expected: Mapping[str, Sequence[str]] | None = None
) -> tuple[list[Row], list[Row]]:
    """Cameras and services, each in the order of their names.

    Args:
        reports: The last report of every node heard.
        expected: Nodes that should be there, by camera id (`""` for the services), in the order to
            show; None: whatever is heard.
    """
    by_place: dict[str, dict[str, NodeReport]] = {}
    for report in reports:
        by_place.setdefault(report.camera_id, {})[report.executable] = report
    wanted = {name: list(nodes) for name, nodes in (expected or {}).items()}
    names = list(wanted) if expected is not None else sorted(by_place)
    cameras = [
        _camera(name, by_place.get(name, {}), wanted.get(name, [])) for name in names if name
    ]
    heard = by_place.get("", {})
    services = [
        _service(name, heard.get(name)) for name in dict.fromkeys([*wanted.get("", []), *heard])
    ]
    return cameras, services


def _camera(name: str, nodes: Mapping[str, NodeReport], wanted: Sequence[str]) -> Row:
    problems = [f"{node}: not heard" for node in wanted if node not in nodes]
    problems += [problem for report in nodes.values() for problem in _problems(report)]
    values = {}
    for column in COLUMNS:
        found = [nodes[n].values.get(key, "") for n, key in column.sources if n in nodes]
        found = [value for value in found if value]
        if found:
            values[column.key] = f"{sum(map(float, found)):g}" if column.summed else found[0]
    values |= _lost(nodes)
    return Row(name, bool(nodes) and not problems, len(nodes), tuple(problems), values)


def _lost(nodes: Mapping[str, NodeReport]) -> dict[str, str]:
    """Frames lost on the way, each once, and their share.

    A frame that one node loses is missing at all nodes after it: the node that lacks most says how
    many there are.
    """
    most, share, missing, known = 0.0, 0.0, 0.0, False
    for node in (nodes[name] for name in _DATA_PATH if name in nodes):
        counts = [float(node.values[key]) for key in _LOSSES if node.values.get(key)]
        known = known or bool(counts)
        missing = max(missing, float(node.values.get("missing") or 0.0))
        if sum(counts) > most:
            most = sum(counts)
            came = float(node.values.get("received") or 0.0)
            share = most / max(came + most, 1.0)
    lost = {"lost": f"{most:g}", "lost_share": f"{share:.3f}", "missing": f"{missing:g}"}
    return lost if known else {}


def _service(name: str, report: NodeReport | None) -> Row:
    if report is None:
        return Row(name, False, 0, ("not heard",))
    problems = tuple(_problems(report))
    return Row(name, not problems, 1, problems, report.values)


def _problems(report: NodeReport) -> Iterable[str]:
    if report.age_s > STALE_S:
        yield f"{report.executable}: silent for {report.age_s:.0f} s"
    elif not report.ok:
        yield f"{report.executable}: {report.message}"
