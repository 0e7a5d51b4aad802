"""`side_by_side_<camera>.png` of `geoorbit twin replay`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import GeoOrbitError

if TYPE_CHECKING:
    from geoorbit_ros.roadnet.network import RoadNetwork
    from geoorbit_ros.twin.placement import TwinStep
    from geoorbit_ros.twin.replay import TrackStream


class BusiestStep:
    """Keeps the step in which cameras saw most vehicles."""

    def __init__(self) -> None:
        self.step: TwinStep | None = None
        self._seen = 0

    def add(self, step: TwinStep) -> None:
        """Take one step."""
        seen = int(np.count_nonzero(step.observed))
        if seen > self._seen:
            self.step, self._seen = step, seen


def save_all_side_by_side(
    folder: Path,
    network: RoadNetwork,
    step: TwinStep | None,
    streams: Sequence[TrackStream],
    bags: Sequence[Path],
    video: Path | None,
) -> list[str]:
    """Write every camera's image; what they show, or why there is none, in one sentence each.

    Args:
        folder: Where they go.
        network: The roads.
        step: The moment; None: no vehicle was ever seen, and nothing is written.
        streams: Tracks, one per camera, put on the road by their calibration.
        bags: The same cameras' boxes.
        video: Of the first camera.
    """
    said: list[str] = []
    for stream, bag in zip(streams, bags, strict=True):
        own_video = video if stream is streams[0] else None
        if step is None:
            break
        try:
            said.append(save_side_by_side(folder, network, step, stream, bag, own_video))
        except GeoOrbitError as error:
            said.append(f"No side-by-side image: {error}")
    return said


def save_side_by_side(
    folder: Path,
    network: RoadNetwork,
    step: TwinStep,
    stream: TrackStream,
    bag: Path,
    video: Path | None,
) -> str:
    """Write one camera's image; what it shows, in one sentence.

    Args:
        folder: Where it goes.
        network: The roads.
        step: The moment.
        stream: The camera's tracks, put on the road by their calibration.
        bag: Its boxes.
        video: Its video, which begins with the bag; None shows the boxes alone.

    Raises:
        GeoOrbitError: The calibration leaves the camera's height open, or a file can't be read.
    """
    from geoorbit_ros.report.image_overlay import write_image
    from geoorbit_ros.storage.track_bag import read_track_bag
    from geoorbit_ros.storage.tracks.cleaning import ReadOptions
    from geoorbit_ros.twin.placement import track_rows
    from geoorbit_ros.twin.side_by_side import TwinCamera

    projector = stream.projector
    assert projector is not None, "a stream of boxes was projected"
    camera = TwinCamera(projector.homography, projector.image_size, network.path, stream.datum)
    # A camera without a name of its own is the only one of its bag.
    camera_id = None if stream.camera == "camera" else stream.camera
    frames = read_track_bag(bag, camera_id, ReadOptions(projector.image_size)).frames
    stamps = frames.stamp_ns
    k = int(np.argmin(np.abs(stamps - step.stamp_ns)))
    image = None if video is None else _image_at(video, int(stamps[k] - stamps[0]))
    shown, difference = camera.beside(
        image, frames.frame(k), track_rows(step), network.datum, stream.alignment
    )
    write_image(folder / f"side_by_side_{stream.camera}.png", shown)
    after_s = (step.stamp_ns - int(stamps[0])) / 1e9
    return f"{stream.camera} after {after_s:.1f} s, boxes seen and rendered: {difference.sentence}."


def _image_at(video: Path, after_ns: int) -> NDArray[np.uint8] | None:
    """The first image of a video that is not earlier than `after_ns` from its beginning."""
    from geoorbit_ros.storage.frames.open_source import open_frame_source

    begin_ns: int | None = None
    latest: NDArray[np.uint8] | None = None
    with open_frame_source(str(video)) as source:
        for stamp_ns, image in source:
            begin_ns = stamp_ns if begin_ns is None else begin_ns
            latest = image
            if stamp_ns - begin_ns >= after_ns - 1_000_000:
                break
    return latest
