"""A rendered scene as a source of images: `scene:on_ramp_merge?seed=1&duration=60`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from types import MappingProxyType

from geoorbit_ros.storage.frames.open_source import SourceMaker
from geoorbit_ros.storage.frames.source import FrameSource, SourceOptions, StampedImage


class SceneFrames(FrameSource):
    """TODO."""

    def __init__(self, spec: str, options: SourceOptions) -> None:
        super().__init__(spec)

    def __iter__(self) -> Iterator[StampedImage]:
        """Stamps and images from the beginning."""
        raise NotImplementedError


SCENES: Mapping[str, SourceMaker] = MappingProxyType({"scene": SceneFrames})
"""For `open_frame_source`."""
