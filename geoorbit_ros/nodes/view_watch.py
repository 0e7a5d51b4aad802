"""Node `view_watch`: how the camera's image lies on its reference view, whatever detects."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from sensor_msgs.msg import PointCloud2

from geoorbit_ros.conversions import encode_table
from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.picture_stream import PictureStream
from geoorbit_ros.nodes.support.process import run_node
from geoorbit_ros.nodes.support.qos import stream_qos
from geoorbit_ros.view.looks import ViewLook
from geoorbit_ros.view.memory import (
    calibration_hash,
    load_places,
    named_files,
    preset_places,
    save_places,
)
from geoorbit_ros.view.picture import Grey
from geoorbit_ros.view.timeline import ViewTimeline, clock_text
from geoorbit_ros.view.watch import ViewWatch

SAVE_PERIOD_S = 60.0
"""Data time between two savings of the reference pictures. Chosen: they change at dusk and dawn;
larger, a killed process forgets a preset; smaller writes more."""


@dataclass(frozen=True, slots=True)
class ViewWatchParameters:
    """See params/view_watch.yaml."""

    calibration_file: str
    state_file: str
    view_images: str
    repeats_allowed: bool
    reliability: str
    queue_depth: int


class ViewWatchNode(GeoOrbitNode[ViewWatchParameters]):
    """Subscribes `image/compressed` and `image`; publishes `view`, one row per look.

    Attributes:
        view: The publisher.
        looks: How many images it looked at.

    Raises:
        GeoOrbitError: A parameter or a view's picture can't be used.
    """

    name = "view_watch"
    struct = ViewWatchParameters

    def setup(self) -> None:
        """Recall the views, then start."""
        p = self.p
        self.looks = 0
        self._mark = calibration_hash(Path(p.calibration_file) if p.calibration_file else None)
        self._file = Path(p.state_file) if p.state_file else None
        self._saved_ns = 0
        self._latest: ViewLook | None = None
        self._timeline = ViewTimeline()
        self._watch = self._recalled()
        qos = stream_qos(p.reliability, p.queue_depth)
        self.view = self.create_publisher(PointCloud2, "view", qos)
        watch = self._watch
        self.stream = PictureStream(self, qos, watch.note, watch.due, self._on_picture)
        self.diagnostics.add_check(self._trouble)

    def diagnostic_values(self) -> Mapping[str, object]:
        """What the camera shows, and what happened last."""
        look = self._latest
        told = self._timeline.told()
        return {
            "images": self.stream.received,
            "looks": self.looks,
            "state": look.state.name.lower() if look else "",
            "view": look.view if look else "",
            "moved_px": f"{look.moved_px:.2f}" if look else "",
            "sway_px": f"{look.sway_px:.2f}" if look else "",
            "sigma_px": f"{look.sigma_px:.3f}" if look else "",
            "views": len(self._watch.places),
            "last_event": told[-1].sentence(clock_text) if told else "",
        }

    def close(self) -> None:
        """End the thread; keep the views."""
        self.stream.stop()
        self._save()

    def _recalled(self) -> ViewWatch:
        p = self.p
        place = f"node '{self.get_fully_qualified_name()}', parameter 'view_images'"
        presets, size = preset_places(named_files(p.view_images, place))
        if self._file is not None:
            try:
                saved, saved_size = load_places(self._file, self._mark)
                if saved and size in (None, saved_size):
                    numbers = {known.number for known in saved}
                    presets = saved + [k for k in presets if k.number not in numbers]
                    size = saved_size
            except GeoOrbitError as error:
                self.get_logger().warning(f"the first image is the reference view: {error}")
        return ViewWatch(presets, size, repeats_allowed=p.repeats_allowed)

    def _on_picture(
        self, stamp_ns: int, frame_id: str, picture: Grey, size: tuple[int, int]
    ) -> None:
        look = self._watch.look_at(stamp_ns, picture, size)
        self._latest, self.looks = look, self.looks + 1
        self.publish_stream(self.view, encode_table(stamp_ns, frame_id, look.row()))
        if self._timeline.add(look) and look.usable:
            self.get_logger().info(self._timeline.stretches[-1].sentence(clock_text))
        if not 0 <= stamp_ns - self._saved_ns < SAVE_PERIOD_S * 1e9:
            self._saved_ns = stamp_ns
            self._save()

    def _save(self) -> None:
        size = self._watch.size
        if self._file is None or size is None:
            return
        try:
            save_places(self._file, self._watch.places, size, self._mark)
        except GeoOrbitError as error:
            self.diagnostics.warn(f"views are not remembered: {error}")

    def _trouble(self) -> str | None:
        """What a person should know of the view."""
        if (error := self.stream.error) is not None:
            return f"stopped by a defect: {type(error).__name__}: {error}"
        stretches = self._timeline.stretches
        if not stretches or not stretches[-1].troubled:
            return None
        return stretches[-1].sentence(clock_text)


def main(args: Sequence[str] | None = None) -> int:
    """Run the node in this process."""
    return run_node(ViewWatchNode, args)


if __name__ == "__main__":
    sys.exit(main())
