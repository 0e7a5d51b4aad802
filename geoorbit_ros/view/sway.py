"""Where a camera that sways was between two looks.

A pole in the wind is an oscillator that is kicked at random: it swings at its own frequency, and
slowly forgets its phase. So its place at one time is known from its places at others by a Gaussian
process whose covariance is a cosine that fades (Rasmussen and Williams (2006), Gaussian Processes
for Machine Learning, equations 2.25, 2.26 and 5.12). Frequency and memory of each axis are those
with which each look is best foretold by the others.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LEAST_LOOKS = 12
"""Looks that a swing's frequency takes. Chosen: two seconds of them; fewer find a frequency in any
noise."""
MOST_LOOKS = 30
"""The latest are taken. Chosen: more know the frequency better and take the cube of the time."""
HIGHEST_HZ = 6.0
"""Poles swing at 0.3 to 3 Hz, arms and brackets up to 6."""
PEAKS = 4
"""Frequencies of the spectrum that are tried. Chosen: looks five times a second show each frequency
at others, too, weaker as they are not evenly spaced."""
FINER = (-0.6, -0.45, -0.3, -0.15, 0.15, 0.3, 0.45, 0.6)
"""Where the best of them is looked for more closely, in quarters of the spectrum's resolution."""
MEMORIES_S = (0.4, 1.0, 2.5, 6.0)
"""How long a swing keeps its phase, of which the best is taken: gusts, a damped pole, a free
one."""
MIDDLE = 1.0
"""Variance of the middle of the swing, over that of the sway: it is found with the rest."""
LEAST_NOISE = 1e-3
"""Of a look, as a share of the sway's variance: keeps the matrices regular."""


@dataclass(frozen=True, slots=True)
class Swing:
    """One axis of a sway.

    Attributes:
        frequency_hz: Of the swing; 0: it does not swing, it wanders.
        memory_s: How long it keeps its phase.
        noise: Variance of a look's error over that of the sway.
        variance: Of the sway, as the looks foretell each other.
    """

    frequency_hz: float
    memory_s: float
    noise: float
    variance: float

    def covariance(self, apart_s: Array) -> Array:
        """Of the places at two times, in units of `variance`."""
        fade = np.exp(-0.5 * (apart_s / self.memory_s) ** 2)
        return np.asarray(MIDDLE + fade * np.cos(2.0 * np.pi * self.frequency_hz * apart_s))

    def weights(self, time_s: Array) -> tuple[Array, float]:
        """(N,) weights of looks at times from now, and the variance of what they give."""
        among = self.covariance(time_s[:, None] - time_s) + self.noise * np.eye(len(time_s))
        to_now = self.covariance(time_s)
        weight = np.linalg.solve(among, to_now)
        left = max(MIDDLE + 1.0 - float(to_now @ weight), 0.0)
        return np.asarray(weight, np.float64), self.variance * left


def find_swing(time_s: Array, place: Array, sigma: float) -> Swing | None:
    """The swing that places (N,) at times (N,) show; None where they are too few.

    Args:
        time_s: Ascending.
        place: In pixels along one axis.
        sigma: 1-sigma of a place's error.
    """
    time_s, place = time_s[-MOST_LOOKS:], place[-MOST_LOOKS:]
    if len(time_s) < LEAST_LOOKS:
        return None
    place = place - place.mean()
    noise = max(sigma**2 / max(float((place**2).mean()), 1e-9), LEAST_NOISE)
    step = 0.25 / float(time_s[-1] - time_s[0])
    rough = np.array([0.0, *_peaks(time_s, place, step)])
    first = _likeliest(time_s, place, noise, rough)
    best = first[1]
    if best.frequency_hz:
        finer = best.frequency_hz + step * np.array(FINER)
        best = min(first, _likeliest(time_s, place, noise, finer), key=lambda k: k[0])[1]
    return best


def _likeliest(time_s: Array, place: Array, noise: float, frequency: Array) -> tuple[float, Swing]:
    """Of the frequencies and all memories those that foretell each look best, and how well."""
    apart = time_s[:, None] - time_s
    fade = np.exp(-0.5 * (apart / np.array(MEMORIES_S)[:, None, None]) ** 2)
    swing = np.cos(2.0 * np.pi * frequency[:, None, None] * apart)
    inverse = np.linalg.inv(MIDDLE + fade * swing[:, None] + noise * np.eye(len(time_s)))
    # Each look without itself: error r v and variance v, in units of the sway's own.
    variance = 1.0 / np.diagonal(inverse, axis1=-2, axis2=-1)
    rest = inverse @ place
    scale = (rest**2 * variance).mean(axis=-1)
    cost = np.log(variance).mean(axis=-1) + np.log(np.maximum(scale, 1e-12))
    f, m = np.unravel_index(int(np.argmin(cost)), cost.shape)
    found = Swing(float(frequency[f]), MEMORIES_S[int(m)], noise, float(scale[f, m]))
    return float(cost[f, m]), found


def _peaks(time_s: Array, place: Array, step: float) -> list[float]:
    """Frequencies at which the spectrum is strongest, each with its neighbours."""
    frequency = np.arange(2.0 * step, HIGHEST_HZ, step)
    wave = np.exp(-2j * np.pi * frequency[:, None] * time_s)
    power = np.abs(wave @ place) ** 2
    found: list[float] = []
    for _ in range(PEAKS):
        k = int(np.argmax(power))
        found += [float(frequency[k] + share * step) for share in (-1.0, 0.0, 1.0)]
        power[max(k - 4, 0) : k + 5] = 0.0
    return found
