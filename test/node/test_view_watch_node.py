"""The node `view_watch`: what the watch says is on the topic, and the other nodes go by it."""

from pathlib import Path

import cv2
import numpy as np
from made_up_camera import MadeUpCamera
from numpy.typing import NDArray
from probe import LOSSLESS, Probe
from sensor_msgs.msg import CompressedImage

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.control_point_file import read_control_points
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.conversions import encode_jpeg
from geoorbit_ros.core.tables import PIXEL_TRACK_DTYPE, TRACK_DTYPE
from geoorbit_ros.nodes.homography import HomographyNode
from geoorbit_ros.nodes.recorder import RecorderNode
from geoorbit_ros.nodes.support.composition import Composition
from geoorbit_ros.nodes.view_watch import ViewWatchNode
from geoorbit_ros.storage.database.reader import TrajectoryReader
from geoorbit_ros.view.compensation import boxes_in_reference
from geoorbit_ros.view.looks import VIEW_DTYPE, ViewLook, ViewState
from geoorbit_ros.view.picture import shifted

SECOND_NS = 10**9


def scenery(right_px: float) -> NDArray[np.uint8]:
    noise = np.random.default_rng(1).normal(0.0, 1.0, (540, 1000))
    soft = sum(cv2.GaussianBlur(noise, (0, 0), sigma) * sigma for sigma in (2.0, 4.0, 8.0))
    grey = np.clip(128.0 + 45.0 * soft / np.std(soft), 0, 255).astype(np.uint8)
    shown = cv2.warpPerspective(grey, shifted(right_px - 20.0, 0.0), (960, 540))
    return np.asarray(cv2.cvtColor(shown, cv2.COLOR_GRAY2BGR), np.uint8)


def look(time_s: float, right_px: float, state: ViewState, sigma_px: float = 0.05) -> ViewLook:
    stamp_ns = round(time_s * SECOND_NS)
    view = 0 if np.isfinite(sigma_px) else -1
    motion = shifted(right_px, 0.0)
    return ViewLook(stamp_ns, state, view, motion, sigma_px, 0.0, abs(right_px), stamp_ns)


def test_a_bump_is_on_the_topic_in_the_diagnostics_and_known_after_a_restart(
    nodes: Composition, camera: MadeUpCamera, tmp_path: Path
) -> None:
    given = {
        "calibration_file": str(camera.calibration),
        "state_file": str(tmp_path / "state" / "views.npz"),
        "reliability": "reliable",
    }
    node = nodes.make(ViewWatchNode, "north", given)
    probe = Probe(nodes)
    looks = probe.listen_tables("view", VIEW_DTYPE)
    images = probe.publisher("image/compressed", CompressedImage)
    here, bumped = scenery(0.0), scenery(14.0)

    def send(time_s: float, image: NDArray[np.uint8], count: int) -> None:
        for k in range(count):
            before = node.looks
            stamp_ns = round((time_s + 0.5 * k) * SECOND_NS)
            shown = image.copy()
            shown[:20, :20] = 4 * k  # the same image again would be a frozen one
            images.publish(encode_jpeg(stamp_ns, "north", shown, 95))
            probe.until(lambda seen=before: node.looks > seen, "a look")  # type: ignore[misc]

    send(1.0, here, 22)
    send(12.0, bumped, 6)
    probe.until(lambda: len(looks) == 28, "the looks")
    assert looks[21][2]["state"][0] == ViewState.STEADY
    row = looks[-1][2][0]
    assert row["state"] == ViewState.MOVED
    assert abs(row["m02"] - 14.0) < 0.3
    status = probe.status_of("/north/view_watch")
    assert "moved by 14 px (14 px to the right" in status["message"]
    node.close()
    again = nodes.make(ViewWatchNode, "north_again", given)
    other = Probe(nodes, "north_again", "other")
    late = other.listen_tables("view", VIEW_DTYPE)
    images = other.publisher("image/compressed", CompressedImage)
    images.publish(encode_jpeg(20 * SECOND_NS, "north", bumped, 95))
    other.until(lambda: len(late) == 1, "a look")
    assert abs(late[0][2]["m02"][0] - 14.0) < 0.3
    assert again.looks == 1


def test_boxes_go_through_the_view_and_unsure_frames_make_no_tracks(
    nodes: Composition, camera: MadeUpCamera
) -> None:
    given = LOSSLESS | {"calibration_file": str(camera.calibration)}
    node = nodes.make(HomographyNode, "north", given)
    probe = Probe(nodes)
    tracks = probe.listen_tables("tracks", TRACK_DTYPE)
    probe.until(lambda: node.tracks.get_subscription_count() == 1, "the node to see the probe")
    send_view, send = probe.table_publisher("view"), probe.table_publisher("tracks_px")
    rows = next(f for k in range(60) if len(f := camera.frames.frame(k)) > 1)
    moved = boxes_in_reference(rows, shifted(14.0, 0.0), camera.image_size)
    for sent in (
        look(1.0, 14.0, ViewState.MOVED),
        look(2.0, 0.0, ViewState.BLIND, np.inf),
        look(3.0, 14.0, ViewState.MOVED),
    ):
        stamp_ns = sent.stamp_ns
        send_view(stamp_ns, sent.row())
        probe.until(
            lambda at=stamp_ns: node.views_until_ns >= at,  # type: ignore[misc]
            "the look",
        )
        send(stamp_ns, moved)
    probe.until(lambda: len(tracks) == 2, "the frames that can be used")
    assert [stamp for stamp, _, _ in tracks] == [SECOND_NS, 3 * SECOND_NS]
    projector = BoxProjector(fit_homography(read_control_points(camera.calibration)), (1920, 1080))
    expected = projector.project(SECOND_NS, rows.astype(PIXEL_TRACK_DTYPE))
    found = tracks[0][2]
    assert set(found["track_id"]) <= set(expected["track_id"])
    kept = expected[np.isin(expected["track_id"], found["track_id"])]
    assert len(kept)
    assert np.abs(kept["x"] - found["x"]).max() < 0.02
    assert (found["sigma"] > kept["sigma"]).all()
    assert node.diagnostic_values()["frames_left_out_by_view"] == 1


def test_what_happened_to_the_view_is_stored(nodes: Composition, tmp_path: Path) -> None:
    path = tmp_path / "t.db"
    nodes.make(RecorderNode, "north", LOSSLESS | {"database": str(path)})
    probe = Probe(nodes)
    send = probe.table_publisher("view")
    for k in range(1, 6):
        send(k * SECOND_NS, look(k, 0.0, ViewState.STEADY).row())
    for k in range(6, 12):
        send(k * SECOND_NS, look(k, 14.0, ViewState.MOVED).row())

    def stored() -> list[tuple[str, float, int]]:
        with TrajectoryReader(path) as reader:
            if not reader.cameras():
                return []
            events = reader.view_events("north")
        return [(k.state, k.moved_px, k.end_ns // SECOND_NS) for k in events]

    probe.until(lambda: stored()[1:] == [("moved", 14.0, 11)], "the events in the file")
    assert stored()[0][0] == "steady"
