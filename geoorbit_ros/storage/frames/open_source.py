"""Opens the source of images that a user names."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from urllib.parse import unquote, urlsplit

from geoorbit_ros.core.addresses import check_address, is_address, masked
from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.storage.frames.image_folder import ImageFolder, is_image
from geoorbit_ros.storage.frames.source import FrameSource, SourceOptions
from geoorbit_ros.storage.frames.stream import Stream
from geoorbit_ros.storage.frames.video_file import VideoFile

SourceMaker = Callable[[str, SourceOptions], FrameSource]
"""Makes a source from the whole text that names it."""

_NONE: Mapping[str, SourceMaker] = MappingProxyType({})


def open_frame_source(
    spec: str, options: SourceOptions | None = None, more: Mapping[str, SourceMaker] = _NONE
) -> FrameSource:
    """Open a video file, a stream, a folder of images, or what a further scheme names.

    Args:
        spec: `recording.mp4`, `rtsp://…` or `http://…`, a folder, or `<scheme>:…` of `more`.
        options: How; default: all defaults.
        more: Makers of further sources by scheme; `rendering.frame_source.SCENES` for `scene:NAME`.

    Raises:
        FrameSourceError: Nothing that can be read. A stream says so only when it is iterated.
        ParameterError: An empty text, or a frame rate that is none.
    """
    options = options or SourceOptions()
    if not spec.strip():
        raise ParameterError("source", "nothing", "a video file, an address, a folder or a scene")
    if options.fps is not None and not 0.0 < options.fps <= 1000.0:
        raise ParameterError("fps", f"{options.fps:g}", "above 0 to 1000 frames per second")
    scheme, colon, _ = spec.partition(":")
    if colon and scheme in more:
        return more[scheme](spec, options)
    if is_address(spec):
        return Stream(spec, options)
    path = Path(local_path(spec))
    if masked(spec) != spec and not path.exists():
        # Plainly meant as an address, with a password that a file's name would show.
        check_address(spec)
    if path.is_dir() or (is_image(path) and path.is_file()):
        return ImageFolder(path, options)
    return VideoFile(path, options)


def local_path(spec: str) -> str:
    """The path of a file or folder that may be written as `file:///…` (RFC 8089)."""
    if spec.lower().startswith("file://") and not Path(spec).exists():
        return unquote(urlsplit(spec).path)
    return spec
