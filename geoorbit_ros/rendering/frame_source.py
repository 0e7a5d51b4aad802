"""A rendered scene as a source of images: `scene:on_ramp_merge?seed=1&duration=60&light=dusk`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import TypeVar
from urllib.parse import parse_qsl

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.rendering.conditions import LIGHTS, Conditions
from geoorbit_ros.rendering.rendered_scene import RenderedScene, check_settings, render_scene
from geoorbit_ros.scenes.scene import Scene, load_scene, with_camera
from geoorbit_ros.scenes.simulate import START_NS
from geoorbit_ros.storage.frames.open_source import SourceMaker
from geoorbit_ros.storage.frames.source import FrameSource, SourceOptions, StampedImage

DEFAULTS: Mapping[str, str] = MappingProxyType(
    {
        "seed": "1",
        "duration": "60",
        "fps": "",
        "size": "",
        "k1": "",
        "k2": "",
        "fov": "",
        "lens_known": "",
        **{f.name: str(f.default) for f in fields(Conditions)},
    }
)
"""What may follow the scene's name, and what it is when it doesn't; empty: as the scene has it."""
_Value = TypeVar("_Value")
_BOOLEANS = {"true": True, "1": True, "false": False, "0": False}


@dataclass(frozen=True, slots=True)
class SceneSpec:
    """What a `scene:` address asks for; `None` as the scene has it."""

    scene: Scene
    duration_s: float
    seed: int
    conditions: Conditions
    fps: float | None
    image_size: tuple[int, int] | None


def read_scene_spec(spec: str) -> SceneSpec:
    """The parts of an address of a scene, without rendering it.

    Args:
        spec: `scene:NAME` or `scene:FILE.yaml`, then `?` and settings joined by `&`: `seed`,
            `duration` in seconds, `fps`, `size` as `1280x720`, the lens' `k1` and `k2`, `fov` in
            degrees, `lens_known` and those of `Conditions`.

    Raises:
        GeoOrbitError: No such scene, or a setting that can't be used.
    """
    name, _, query = spec.partition(":")[2].partition("?")
    given = _Settings(spec, dict(DEFAULTS))
    asked = parse_qsl(query, keep_blank_values=True)
    for key, value in asked:
        if [k for k, _ in asked].count(key) > 1:
            raise ParameterError(f"source {spec}", f"'{key}' more than once", "each setting once")
        if key not in DEFAULTS:
            raise ParameterError(f"source {spec}", f"'{key}'", f"one of {', '.join(DEFAULTS)}")
        given.text[key] = value
    found = SceneSpec(
        given.with_lens(load_scene(name)),
        given.positive("duration"),
        int(given.number("seed", whole=True)),
        Conditions(
            light=given.choice("light", {light: light for light in LIGHTS}),
            rain=given.choice("rain", _BOOLEANS),
            shake_px=given.number("shake_px"),
            clouds=given.number("clouds"),
            worn=given.number("worn"),
            shadows=given.choice("shadows", _BOOLEANS),
        ),
        given.positive("fps") if given.text["fps"] else None,
        given.size(),
    )
    check_settings(found.duration_s, found.seed, found.fps, found.image_size)
    return found


class SceneFrames(FrameSource):
    """Renders a scene, again for each iteration; the same text gives the same images.

    Args:
        spec: As for `read_scene_spec`.
        options: Only `start_ns` concerns it.

    Attributes:
        image_size: Width and height.
        control_points: Surveyed points with their pixels in these images.
        datum: Origin of the control points' map frame.

    Raises:
        GeoOrbitError: As `read_scene_spec`.
    """

    def __init__(self, spec: str, options: SourceOptions) -> None:
        super().__init__(spec)
        self._start_ns = options.start_ns
        self._note_unused(options.fps, "a scene's rate is written scene:NAME?fps=10")
        self._spec = read_scene_spec(spec)
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
            self._spec.scene,
            self._spec.duration_s,
            self._spec.seed,
            self._spec.conditions,
            fps=self._spec.fps,
            image_size=self._spec.image_size,
        )


@dataclass(frozen=True, slots=True)
class _Settings:
    """The settings of an address as text, and as what they must be."""

    spec: str
    text: dict[str, str]

    def number(self, key: str, *, whole: bool = False) -> float:
        try:
            return int(self.text[key]) if whole else float(self.text[key])
        except ValueError:
            raise self._refused(key, "a whole number" if whole else "a number") from None

    def positive(self, key: str) -> float:
        number = self.number(key)
        if not 0.0 < number < math.inf:
            raise self._refused(key, "a number above 0")
        return number

    def choice(self, key: str, values: Mapping[str, _Value]) -> _Value:
        text = self.text[key].lower()
        if text not in values:
            raise self._refused(key, f"one of {', '.join(values)}")
        return values[text]

    def with_lens(self, scene: Scene) -> Scene:
        """The scene with another lens or zoom, where the address says so."""
        names = {"k1": "k1", "k2": "k2", "fov": "horizontal_fov_deg"}
        asked: dict[str, float | bool] = {
            field: self.number(key) for key, field in names.items() if self.text[key]
        }
        if self.text["lens_known"]:
            asked["lens_known"] = self.choice("lens_known", _BOOLEANS)
        return with_camera(scene, asked, f"source {self.spec}") if asked else scene

    def size(self) -> tuple[int, int] | None:
        text = self.text["size"]
        parts = text.split("x")
        if text and not (len(parts) == 2 and all(part.isdecimal() for part in parts)):
            raise self._refused("size", "WIDTHxHEIGHT such as 1280x720")
        return (int(parts[0]), int(parts[1])) if text else None

    def _refused(self, key: str, expected: str) -> ParameterError:
        return ParameterError(f"source {self.spec}, '{key}'", f"'{self.text[key]}'", expected)


SCENES: Mapping[str, SourceMaker] = MappingProxyType({"scene": SceneFrames})
"""For `open_frame_source`."""
