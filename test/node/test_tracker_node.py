"""The tracker node: the same tracks as the tracker, frame by frame, whatever comes in."""

from functools import partial

import numpy as np
import pytest
from probe import LOSSLESS, Probe

from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.core.tables import DETECTION_DTYPE, PIXEL_TRACK_DTYPE
from geoorbit_ros.nodes.support.composition import Composition
from geoorbit_ros.nodes.tracker import TrackerNode
from geoorbit_ros.tracking.parameters import TrackerParameters, first_id_at
from geoorbit_ros.tracking.tracker import Tracker

PERIOD_NS = 40_000_000
START_NS = 1_000_000_000


def detections(k: int) -> np.ndarray:
    """Two vehicles in opposite directions, the second one missing in some frames."""
    rows = np.zeros(2 if k % 7 else 1, DETECTION_DTYPE)
    rows["x"] = [100.0 + 12.0 * k, 900.0 - 10.0 * k][: len(rows)]
    rows["y"] = [200.0, 300.0][: len(rows)]
    rows["width"], rows["height"], rows["score"], rows["class_id"] = 90.0, 60.0, 0.9, 2
    return rows


class Tracked:
    """A tracker node with its input and output."""

    def __init__(self, nodes: Composition, **overrides: object) -> None:
        self.node = nodes.make(TrackerNode, "north", LOSSLESS | overrides)
        self.probe = Probe(nodes)
        self.heard = self.probe.listen_tables("tracks_px", PIXEL_TRACK_DTYPE)
        self.probe.until(lambda: self.node.tracks.get_subscription_count() == 1, "the probe")
        self.send = self.probe.table_publisher("detections")

    def wait(self, count: int) -> None:
        self.probe.until(lambda: len(self.heard) == count, f"{count} frames")


def test_tracks_are_bit_for_bit_those_of_the_tracker(nodes: Composition) -> None:
    tracked = Tracked(nodes)
    stamps = [START_NS + PERIOD_NS * k for k in range(40)]
    for k, stamp_ns in enumerate(stamps):
        tracked.send(stamp_ns, detections(k))
    tracked.wait(len(stamps))
    tracker = Tracker(TrackerParameters(first_id=first_id_at(START_NS)))
    for k, (stamp_ns, frame_id, rows) in enumerate(tracked.heard):
        assert (stamp_ns, frame_id) == (stamps[k], "probe")
        assert rows.tobytes() == tracker.update(stamp_ns, detections(k)).tobytes()
    status = tracked.probe.status_of("/north/tracker")
    assert (status["tracks_alive"], status["total_births"], status["total_deaths"]) == (
        "2",
        "2",
        "0",
    )


def test_a_silent_and_restarted_detector_costs_no_id(nodes: Composition) -> None:
    tracked = Tracked(nodes, max_gap_s=2.0)
    frames = [*range(20), *range(50, 60)]  # 1.2 s without a message
    for k in frames:
        tracked.send(START_NS + PERIOD_NS * k, detections(k))
    tracked.wait(len(frames))
    before, after = tracked.heard[19][2], tracked.heard[-1][2]
    assert before["track_id"].tolist() == after["track_id"].tolist()


def test_a_source_that_starts_again_gets_new_ids(nodes: Composition) -> None:
    tracked = Tracked(nodes, first_id=1)
    for _ in range(2):
        for k in range(1, 7):
            tracked.send(START_NS + PERIOD_NS * 10 * k, detections(k))
    tracked.wait(12)
    first = {int(i) for _, _, rows in tracked.heard[:6] for i in rows["track_id"]}
    second = {int(i) for _, _, rows in tracked.heard[6:] for i in rows["track_id"]}
    assert first == {1, 2}
    assert second == {3, 4}


def test_what_can_not_be_used_is_refused_and_ids_live_on(nodes: Composition) -> None:
    tracked = Tracked(nodes)
    for k in range(5):
        tracked.send(START_NS + PERIOD_NS * k, detections(k))
    tracked.wait(5)
    tracked.send(START_NS + PERIOD_NS * 2, detections(2))  # late
    tracked.probe.until(partial(_refused, tracked.node, 1), "the refusal")
    spoilt = detections(5)
    spoilt["x"][0] = np.nan
    tracked.send(START_NS + PERIOD_NS * 5, spoilt)
    tracked.send(START_NS + PERIOD_NS * 6, detections(6))
    tracked.wait(7)
    assert tracked.heard[4][2]["track_id"].tolist() == tracked.heard[6][2]["track_id"].tolist()
    status = tracked.probe.status_of("/north/tracker")
    assert (status["refused"], status["total_unusable"]) == ("1", "1")


def test_boxes_outside_the_stated_image_are_reported(nodes: Composition) -> None:
    tracked = Tracked(nodes, image_width=320, image_height=240)
    tracked.send(START_NS, detections(1))
    tracked.wait(1)
    status = tracked.probe.status_of("/north/tracker")
    assert status["level"] == "1"
    assert "a box at (890, 300), expected an image of 320 x 240 pixels" in status["message"]


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"high_score": 2.0}, ("high_score", "0", "1")),
        ({"image_width": 1920}, ("image_width", "image_height", "1920 x 0")),
        ({"confirm_hits": 0}, ("confirm_hits",)),
    ],
)
def test_a_bad_start_is_one_sentence(
    nodes: Composition, overrides: dict[str, object], words: tuple[str, ...]
) -> None:
    with pytest.raises(GeoOrbitError) as caught:
        nodes.make(TrackerNode, "north", overrides)
    assert "\n" not in str(caught.value)
    assert all(word in str(caught.value) for word in words)


def _refused(node: TrackerNode, count: int) -> bool:
    return node.diagnostics.refused == count
