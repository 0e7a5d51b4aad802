"""What reports of nodes become in the table of `geoorbit status`."""

from geoorbit_ros.fleet.health import STALE_S, NodeReport, rows


def report(name: str, age_s: float = 0.5, *, ok: bool = True, **values: object) -> NodeReport:
    message = "ok" if ok else "7 frames missing"
    return NodeReport(name, ok, message, {key: str(value) for key, value in values.items()}, age_s)


CAMERA = [
    report("/north/camera", dropped=2, rate_hz=25.0),
    report("/north/homography", rate_hz=24.9, age_ms_p99=80.0, vehicles=5, missing=3, refused=0),
    report("/north/lane_geometry", lanes_confirmed=4, lanes_tentative=1, parameter_version="own"),
    report("/north/meta_client", round=7),
]


def test_a_camera_is_one_row_of_its_nodes_values() -> None:
    (north,), services = rows(CAMERA)
    assert (north.name, north.healthy, north.nodes, services) == ("north", True, 4, [])
    assert north.values == {
        "rate_hz": "24.9",
        "latency_ms": "80.0",
        "lost": "3",  # the two that the camera dropped are among those missing
        "lost_share": "1.000",
        "dropped": "2",
        "missing": "3",
        "refused": "0",
        "vehicles": "5",
        "lanes_confirmed": "4",
        "lanes_tentative": "1",
        "parameters": "own",
        "round": "7",
    }


def test_a_frame_that_is_lost_on_the_way_counts_once() -> None:
    nodes = ("camera", "detector", "tracker", "homography", "lane_geometry")
    behind = [report(f"/north/{name}", missing=6, refused=0, received=94) for name in nodes[1:]]
    behind[-1] = report("/north/lane_geometry", missing=6, refused=1, received=94)
    (north,), _ = rows([report("/north/camera", dropped=6), *behind])
    assert (north.values["lost"], north.values["missing"]) == ("7", "6")
    assert north.values["lost_share"] == f"{7 / 101:.3f}"
    (north,), _ = rows([report("/north/tracker", missing=0, refused=0, received=9)])
    assert (north.values["lost"], north.values["lost_share"]) == ("0", "0.000")


def test_what_is_silent_at_fault_or_not_heard_is_said() -> None:
    heard = [
        report("/north/tracker", STALE_S + 1.0),
        report("/north/homography", ok=False),
        report("/viewer", port=8765),
    ]
    expected = {"": ["federated_server", "viewer"], "north": ["tracker", "homography", "recorder"]}
    (north,), (server, viewer) = rows(heard, expected)
    assert north.problems == (
        "recorder: not heard",
        "tracker: silent for 6 s",
        "homography: 7 frames missing",
    )
    assert (server.problems, server.healthy) == (("not heard",), False)
    assert (viewer.problems, viewer.healthy) == ((), True)


def test_a_service_is_said_in_words_and_an_unknown_one_by_all_its_values() -> None:
    bridge = report("/sumo_bridge", vehicles=12, error_m_p95="0.003", other_lane_share="", steps=9)
    stranger = report("/carla", actors=3, fps="")
    _, (twin, other) = rows([bridge, stranger])
    assert {twin.words, other.words} == {"12 vehicles, error 0.003 m (95 %)", "actors 3"}
