"""What a node says about itself once a second."""

import time

import numpy as np
from probe import LOSSLESS, Probe

from geoorbit_ros.core.tables import TRACK_DTYPE
from geoorbit_ros.nodes.lane_geometry import LaneGeometryNode
from geoorbit_ros.nodes.support.composition import Composition

FRAME_NS = 33_333_333


def test_counts_rate_latency_and_missing_frames(nodes: Composition) -> None:
    node = nodes.make(LaneGeometryNode, "north", LOSSLESS)
    probe = Probe(nodes)
    send = probe.table_publisher("tracks")
    stamps = [10**9 + k * FRAME_NS for k in range(50) if k not in (40, 41)]
    for stamp_ns in stamps:
        send(stamp_ns, np.empty(0, TRACK_DTYPE))
    probe.until(lambda: node.diagnostics.received == len(stamps), "all frames")
    status = probe.status_of("/north/lane_geometry")
    assert status["received"] == str(len(stamps))
    assert status["missing"] == "2"
    assert status["message"] == "2 frames missing"
    assert status["level"] == "1"
    assert float(status["rate_hz"]) > 10
    assert 0 < float(status["latency_ms_median"]) <= float(status["latency_ms_p99"])
    quiet = probe.status_of("/north/lane_geometry")
    assert (quiet["level"], quiet["rate_hz"]) == ("0", "0.0")


def test_frames_that_come_late_after_all_are_no_fault(nodes: Composition) -> None:
    node = nodes.make(LaneGeometryNode, "north", LOSSLESS)
    probe = Probe(nodes)
    node.diagnostics.received, node.diagnostics.missing = 50, 2
    node.diagnostics.report()
    node.diagnostics.received, node.diagnostics.missing = 52, 0
    status = probe.status_of("/north/lane_geometry")
    assert (status["level"], status["message"], status["missing"]) == ("0", "ok", "0")


def test_a_frame_of_the_present_has_an_age_and_a_recording_has_none(nodes: Composition) -> None:
    node = nodes.make(LaneGeometryNode, "north", LOSSLESS)
    probe = Probe(nodes)
    send = probe.table_publisher("tracks")
    send(10**9, np.empty(0, TRACK_DTYPE))
    probe.until(lambda: node.diagnostics.received == 1, "the frame of 1970")
    assert probe.status_of("/north/lane_geometry")["age_ms_p99"] == ""
    for age_ns in (350_000_000, 250_000_000):  # the second says that the first was no wrong stamp
        send(time.time_ns() - age_ns, np.empty(0, TRACK_DTYPE))
    probe.until(lambda: node.diagnostics.received == 3, "the frames of a quarter second ago")
    assert float(probe.status_of("/north/lane_geometry")["age_ms_p99"]) > 250.0


def test_they_come_although_simulated_time_stands_still(nodes: Composition) -> None:
    nodes.make(LaneGeometryNode, "north", LOSSLESS | {"use_sim_time": True})
    status = Probe(nodes).status_of("/north/lane_geometry")
    assert status["message"] == "nothing received yet"
    assert status["datum"] == "not received yet"
