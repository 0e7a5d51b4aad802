"""The bag player: every message as recorded, at its time, whatever the speed."""

import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_up_camera import MadeUpCamera
from probe import KEEP_ALL, LIMIT_S, Probe
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import UInt64
from std_srvs.srv import SetBool

from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.core.tables import PIXEL_TRACK_DTYPE
from geoorbit_ros.nodes.bag_player import CLOCK_QOS, BagPlayerNode
from geoorbit_ros.nodes.support.composition import Composition
from geoorbit_ros.storage.bag_reader import bag_messages

LOSSLESS = {"queue_depth": 0, "rate": 0.0}


def start(nodes: Composition, camera: MadeUpCamera, **overrides: object) -> BagPlayerNode:
    return nodes.make(BagPlayerNode, "", LOSSLESS | {"bag": str(camera.bag)} | overrides)


def listen_raw(probe: Probe, topic: str) -> list[bytes]:
    heard: list[bytes] = []
    probe.node.create_subscription(PointCloud2, topic, heard.append, KEEP_ALL, raw=True)
    return heard


def test_every_message_arrives_as_recorded_and_in_order(
    nodes: Composition, camera: MadeUpCamera
) -> None:
    probe = Probe(nodes)
    heard = listen_raw(probe, "tracks_px")
    finished = probe.listen("/bag_player/finished", UInt64)
    node = start(nodes, camera)
    probe.until(lambda: bool(finished) and len(heard) == len(camera.frames), "all messages")
    assert heard == [message.cdr for message in bag_messages(camera.bag)]
    assert finished[0].data == len(camera.frames)
    assert node.done


def test_the_clock_shows_the_recordings_time_and_never_runs_back(
    nodes: Composition, camera: MadeUpCamera
) -> None:
    probe = Probe(nodes)
    ticks: list[int] = []

    def tick(message: Clock) -> None:
        ticks.append(message.clock.sec * 10**9 + message.clock.nanosec)

    probe.node.create_subscription(Clock, "/clock", tick, CLOCK_QOS)
    heard = probe.listen_tables("tracks_px", PIXEL_TRACK_DTYPE)
    start(nodes, camera, rate=50.0)
    probe.until(lambda: len(heard) == len(camera.frames), "all messages")
    last_ns = int(camera.frames.stamp_ns[-1])
    probe.until(lambda: bool(ticks) and ticks[-1] == last_ns, "the last tick")
    assert np.all(np.diff(ticks) >= 0)
    assert ticks[0] >= camera.frames.stamp_ns[0]
    assert len(set(ticks)) > 20, "time flows between messages"


def test_time_passes_at_the_rate_asked_for(nodes: Composition, camera: MadeUpCamera) -> None:
    probe = Probe(nodes)
    heard = listen_raw(probe, "tracks_px")
    node = start(nodes, camera, rate=20.0)
    probe.until(lambda: len(heard) > 0, "the first message")
    begin = time.monotonic()
    probe.until(lambda: node.done, "the end")
    recorded_s = (camera.frames.stamp_ns[-1] - camera.frames.stamp_ns[0]) / 1e9
    assert time.monotonic() - begin >= recorded_s / 20.0 - 0.1, "never faster than asked"


def test_it_waits_for_subscribers_but_not_for_ever(
    nodes: Composition, camera: MadeUpCamera
) -> None:
    node = start(nodes, camera, wait_timeout_s=0.5)
    begin = time.monotonic()
    nodes.wait(lambda: node.done, LIMIT_S, "the end")
    assert time.monotonic() - begin >= 0.5
    assert node.diagnostics.published == len(camera.frames)


def test_pause_holds_and_resume_goes_on_where_it_was(
    nodes: Composition, camera: MadeUpCamera
) -> None:
    probe = Probe(nodes)
    heard = listen_raw(probe, "tracks_px")
    node = start(nodes, camera, start_paused=True)
    assert probe.call("/bag_player/pause", SetBool, SetBool.Request(data=True)).message == "paused"
    status = probe.status_of("/bag_player")
    assert (status["paused"], status["published"], heard) == ("True", "0", [])
    answer = probe.call("/bag_player/pause", SetBool, SetBool.Request(data=False))
    assert answer.message == "playing"
    probe.until(lambda: node.done and len(heard) == len(camera.frames), "all messages")


def test_another_camera_name_an_offset_and_chosen_topics(
    nodes: Composition, camera: MadeUpCamera
) -> None:
    probe = Probe(nodes, namespace="south")
    heard = listen_raw(probe, "tracks_px")
    node = start(nodes, camera, camera_id="south", start_offset_s=5.0, topics="/north/tracks_px")
    probe.until(lambda: node.done, "the end")
    left_out = int(np.searchsorted(camera.frames.stamp_ns, camera.frames.stamp_ns[0] + 5 * 10**9))
    probe.until(lambda: len(heard) == len(camera.frames) - left_out, "the rest")


def test_a_loop_begins_again_with_stamps_that_go_on(
    nodes: Composition, camera: MadeUpCamera
) -> None:
    probe, count = Probe(nodes), len(camera.frames)
    heard = probe.listen_tables("tracks_px", PIXEL_TRACK_DTYPE)
    node = start(nodes, camera, loop=True)
    probe.until(lambda: len(heard) > 2 * count, "the third round")
    stamps = np.array([stamp_ns for stamp_ns, _, _ in heard])
    assert np.all(np.diff(stamps) > 0)
    period_ns = stamps[count] - stamps[0]
    assert np.all(stamps[count : 2 * count] - stamps[:count] == period_ns)
    assert period_ns > camera.frames.stamp_ns[-1] - camera.frames.stamp_ns[0]
    for (_, _, first), (_, _, second) in zip(heard[:count], heard[count:], strict=False):
        assert first.tobytes() == second.tobytes()
    assert not node.done


def test_a_recording_can_be_played_as_if_it_were_live(
    nodes: Composition, camera: MadeUpCamera
) -> None:
    probe, count = Probe(nodes), len(camera.frames)
    heard = probe.listen_tables("tracks_px", PIXEL_TRACK_DTYPE)
    before_ns = time.time_ns()
    start(nodes, camera, stamp_now=True)
    probe.until(lambda: len(heard) == count, "the recording")
    stamps = np.array([stamp_ns for stamp_ns, _, _ in heard])
    assert before_ns <= stamps[0] <= time.time_ns()
    assert np.array_equal(np.diff(stamps), np.diff(camera.frames.stamp_ns))


def test_a_player_that_stays_says_once_that_it_is_done(
    nodes: Composition, camera: MadeUpCamera
) -> None:
    probe = Probe(nodes)
    heard = listen_raw(probe, "tracks_px")
    finished = probe.listen("/bag_player/finished", UInt64)
    node = start(nodes, camera, exit_when_done=False)
    probe.until(lambda: node.finished and bool(finished), "the end")
    status = probe.status_of("/bag_player")
    assert status["published"] == str(len(camera.frames))
    assert (len(heard), len(finished), node.done) == (len(camera.frames), 1, False)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"bag": "/nowhere"}, ("/nowhere",)),
        ({"bag": ""}, ("/bag_player", "'bag'", "not empty")),
        ({"rate": -1.0}, ("/bag_player", "'rate'", "-1.0", "0 to 1000")),
        ({"start_offset_s": 1000.0}, ("no message to play",)),
        ({"topics": "/other"}, ("no message to play",)),
    ],
)
def test_a_bad_start_is_one_sentence(
    nodes: Composition, camera: MadeUpCamera, overrides: dict[str, Any], words: tuple[str, ...]
) -> None:
    with pytest.raises(GeoOrbitError) as caught:
        start(nodes, camera, **overrides)
    assert "\n" not in str(caught.value)
    assert all(word in str(caught.value) for word in words), str(caught.value)


def test_a_bag_that_breaks_off_is_played_as_far_as_it_goes_and_told(
    nodes: Composition, camera: MadeUpCamera, tmp_path: Path
) -> None:
    broken = tmp_path / "broken"
    shutil.copytree(camera.bag, broken)
    recording = next(broken.glob("*.mcap"))
    recording.write_bytes(recording.read_bytes()[:-2000])
    probe = Probe(nodes)
    node = start(nodes, camera, bag=str(broken), wait_for_subscribers=0, exit_when_done=False)
    nodes.wait(lambda: node.finished, LIMIT_S, "the end")
    assert node.diagnostics.published == len(list(bag_messages(broken))) > 0
    assert "has no end" in probe.status_of("/bag_player")["bag_remarks"]
