"""Light and weather that an image is taken in, and the state of the road's paint."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import ParameterError

Light = Literal["day", "dusk", "night"]
LIGHTS: tuple[Light, ...] = get_args(Light)
MAX_SHAKE_PX = 20.0
"""Largest sway. Chosen: a camera that sways more is of no use."""
MOST_WORN = 0.95
"""Largest share of the paint that can be gone. Chosen: a road without lines is another road."""

Colour = tuple[float, float, float]
"""Blue, green, red; 1 is a white sheet in full sun, as displayed."""


@dataclass(frozen=True, slots=True)
class Conditions:
    """What the weather, the pole and the years do.

    Attributes:
        light: Time of day.
        rain: Whether it rains: wet road, no sun, streaks.
        shake_px: 1-sigma of the camera's sway in the wind, about every two seconds.
        clouds: How much the light drifts, as a share of its mean; 0 for a cloudless sky.
        worn: Share of the paint that is gone, in patches; the rest is pale.
        shadows: Whether gantries and guard rails throw shadows on the road where the sun shines.

    Raises:
        ParameterError: Another light, or a number out of range.
    """

    light: Light = "day"
    rain: bool = False
    shake_px: float = 0.0
    clouds: float = 0.08
    worn: float = 0.0
    shadows: bool = False

    def __post_init__(self) -> None:
        if self.light not in LIGHTS:
            raise ParameterError("light", f"'{self.light}'", f"one of {', '.join(LIGHTS)}")
        if not 0.0 <= self.shake_px <= MAX_SHAKE_PX:
            raise ParameterError("shake_px", f"{self.shake_px:g}", f"0 to {MAX_SHAKE_PX:g} px")
        if not 0.0 <= self.clouds <= 0.5:
            raise ParameterError("clouds", f"{self.clouds:g}", "0 to 0.5")
        if not 0.0 <= self.worn <= MOST_WORN:
            raise ParameterError("worn", f"{self.worn:g}", f"0 to {MOST_WORN:g}")


@dataclass(frozen=True, slots=True)
class Illumination:
    """Where light comes from, in display values.

    Attributes:
        ambient: Sky light on level ground; a colour's share that is shown of a surface in shade.
        sun: Added on a surface that faces the sun.
        sun_direction: (3,) unit vector to the sun.
        zenith: Colour of the sky above.
        horizon: Colour of the sky at the horizon, and of haze.
        haze_m: Distance at which haze takes 63 % of a colour.
        headlights: 0 off, 1 the brightest lights in the image.
        noise: 1-sigma of the sensor's noise in grey levels.
    """

    ambient: Colour
    sun: Colour
    sun_direction: NDArray[np.float64]
    zenith: Colour
    horizon: Colour
    haze_m: float
    headlights: float
    noise: float


_DRY: dict[Light, tuple[Colour, Colour, float, Colour, Colour, float, float, float]] = {
    "day": (
        (0.50, 0.45, 0.42),
        (0.66, 0.76, 0.80),
        44.0,
        (0.80, 0.58, 0.36),
        (0.92, 0.88, 0.82),
        2200.0,
        0.0,
        1.6,
    ),
    "dusk": (
        (0.40, 0.33, 0.32),
        (0.04, 0.08, 0.14),
        6.0,
        (0.52, 0.38, 0.30),
        (0.50, 0.62, 0.82),
        1600.0,
        0.55,
        2.6,
    ),
    "night": (
        (0.165, 0.135, 0.12),
        (0.0, 0.0, 0.0),
        30.0,
        (0.10, 0.07, 0.06),
        (0.17, 0.155, 0.16),
        1500.0,
        1.0,
        3.6,
    ),
}
"""Ambient, sun, sun's elevation in degrees, zenith, horizon, haze, headlights, noise in dry
weather: see `Illumination`. Chosen by appearance."""
_RAIN_SKY: dict[Light, tuple[Colour, Colour]] = {
    "day": ((0.66, 0.64, 0.62), (0.74, 0.73, 0.71)),
    "dusk": ((0.34, 0.30, 0.28), (0.42, 0.40, 0.40)),
    "night": ((0.11, 0.10, 0.095), (0.17, 0.165, 0.165)),
}
"""Zenith and horizon in rain. Chosen by appearance."""


def illumination(conditions: Conditions, azimuth_rad: float) -> Illumination:
    """Light under `conditions` with the sun towards `azimuth_rad`, counter-clockwise from east."""
    ambient, sun, elevation, zenith, horizon, haze, headlights, noise = _DRY[conditions.light]
    if conditions.rain:
        zenith, horizon = _RAIN_SKY[conditions.light]
        ambient = _scaled(ambient, 1.25 if conditions.light == "day" else 0.9)
        sun, haze = (0.0, 0.0, 0.0), 330.0
        headlights, noise = max(headlights, 0.35), 1.3 * noise
    up = np.radians(elevation)
    flat = np.cos(up)
    direction = np.array([flat * np.cos(azimuth_rad), flat * np.sin(azimuth_rad), np.sin(up)])
    return Illumination(ambient, sun, direction, zenith, horizon, haze, headlights, noise)


def channels(colour: Colour) -> NDArray[np.float32]:
    """(3,) a colour to compute with."""
    return np.asarray(colour, dtype=np.float32)


def _scaled(colour: Colour, factor: float) -> Colour:
    blue, green, red = colour
    return blue * factor, green * factor, red * factor
