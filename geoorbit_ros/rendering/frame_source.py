"""A rendered scene as a source of images: `scene:on_ramp_merge?seed=1&duration=60&light=dusk`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields
from types import MappingProxyType
from typing import TypeVar
from urllib.parse import parse_qsl

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.rendering.conditions import LIGHTS, Conditions
from geoorbit_ros.rendering.rendered_scene import RenderedScene, render_scene
from geoorbit_ros.scenes.scene import Scene, load_scene
from geoorbit_ros.scenes.simulate import START_NS
from geoorbit_ros.storage.frames.open_source import SourceMaker
from geoorbit_ros.storage.frames.source import FrameSource, SourceOptions, StampedImage

DEFAULTS: Mapping[str, str] = MappingProxyType(
    {
        "seed": "1",
        "duration": "60",
        "fps": "",
        "size": "",
        **{f.name: str(f.default) for f in fields(Conditions)},
    }
)
"""What may follow the scene's name, and what it is when it doesn't; empty: as the scene has it."""
_Value = TypeVar("_Value")
_BOOLEANS = {"true": True, "1": True, "false": False, "0": False}


class SceneFrames(FrameSource):
    """Renders a scene, again for each iteration; the same text gives the same images.

    Args:
        spec: `scene:NAME` or `scene:FILE.yaml`, then `?` and settings joined by `&`: `seed`,
            `duration` in seconds, `fps`, `size` as `1280x720`, and those of `Conditions`.
        options: Only `start_ns` concerns it.

    Attributes:
        image_size: Width and height.
        control_points: Surveyed points with their pixels in these images.
        datum: Origin of the control points' map frame.

    Raises:
        GeoOrbitError: No such scene, or a setting that can't be used.
    """

    def __init__(self, spec: str, options: SourceOptions) -> None:
        super().__init__(spec)
        self._start_ns = options.start_ns
        self._note_unused(options.fps, "a scene's rate is written scene:NAME?fps=10")
        name, _, query = spec.partition(":")[2].partition("?")
        self._settings = dict(DEFAULTS)
        for key, value in parse_qsl(query, keep_blank_values=True):
            if key not in DEFAULTS:
                raise ParameterError(f"source {spec}", f"'{key}'", f"one of {', '.join(DEFAULTS)}")
            self._settings[key] = value
        self._scene: Scene = load_scene(name)
        first = self._render()
        self.fps, self.frame_count = first.fps, first.frame_count
        self.image_size, self.datum = first.camera.image_size, first.datum
        self.control_points = first.control_points
        self._ready: RenderedScene | None = first

    def __iter__(self) -> Iterator[StampedImage]:
        """Stamps and images from the beginning."""
        rendered, self._ready = self._ready or self._render(), None
        for frame in rendered:
            if self._closed.is_set():
                return
            yield frame.stamp_ns - START_NS + self._start_ns, frame.image

    def _render(self) -> RenderedScene:
        return render_scene(
            self._scene,
            self._number("duration"),
            int(self._number("seed", whole=True)),
            Conditions(
                light=self._choice("light", {light: light for light in LIGHTS}),
                rain=self._choice("rain", _BOOLEANS),
                shake_px=self._number("shake_px"),
                clouds=self._number("clouds"),
            ),
            fps=self._number("fps") if self._settings["fps"] else None,
            image_size=self._size(),
        )

    def _number(self, key: str, *, whole: bool = False) -> float:
        text = self._settings[key]
        try:
            return int(text) if whole else float(text)
        except ValueError:
            raise self._refused(key, "a whole number" if whole else "a number") from None

    def _choice(self, key: str, values: Mapping[str, _Value]) -> _Value:
        text = self._settings[key].lower()
        if text not in values:
            raise self._refused(key, f"one of {', '.join(values)}")
        return values[text]

    def _size(self) -> tuple[int, int] | None:
        text = self._settings["size"]
        parts = text.split("x")
        if text and not (len(parts) == 2 and all(part.isdecimal() for part in parts)):
            raise self._refused("size", "WIDTHxHEIGHT such as 1280x720")
        return (int(parts[0]), int(parts[1])) if text else None

    def _refused(self, key: str, expected: str) -> ParameterError:
        return ParameterError(f"source {self.name}, '{key}'", f"'{self._settings[key]}'", expected)


SCENES: Mapping[str, SourceMaker] = MappingProxyType({"scene": SceneFrames})
"""For `open_frame_source`."""
