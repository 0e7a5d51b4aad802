"""How sure distances along and across the road are, and what in a calibration is doubtful."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.robust import jacobian
from geoorbit_ros.calibration.traffic.estimate import TrafficCalibration
from geoorbit_ros.calibration.traffic.parameters import (
    FOCAL,
    KNOWN_FOCAL_SIGMA,
    projection_matrix,
)
from geoorbit_ros.calibration.vehicle_size import BUS

Array = NDArray[np.float64]

STEP = 0.05
"""Share of a 1-sigma step over which slopes are taken."""
UNSURE = 0.08
"""Distances along the road that are less sure are told to be so. Chosen: a speed of 100 km/h is
then off by 8 km/h in one case of three."""
FOCAL_SIGMAS = 3.0
"""A given focal length that is so many sigma from that of the boxes is doubted. Chosen: smaller
doubts good ones in unusual traffic, larger believes those of another zoom."""
BUSES, FEW_BUSES = 0.4, 5
"""More buses than this share of all vehicles, and at least so many, are probably cars: on ordinary
roads 1 to 5 % are buses. Chosen: larger takes cars for buses of 12 m, smaller doubts bus stations.
"""
OFF_AXIS = 0.02
"""A principal point that is further from the image's middle, as a share of its width, is told:
cameras differ by less, cut and digitally zoomed images by more."""


def scale_sigmas(found: TrafficCalibration) -> tuple[float, float]:
    """Relative 1-sigma errors of distances along and across the vehicles' ways, where they drive.

    In the median over their places, from the parameters' covariance.
    """
    explained = found.explained
    good = explained.fit.good
    ground = np.vstack((explained.fit.xy[:, good], np.ones(int(good.sum()))))
    uvw = found.projection[:, [0, 1, 3]] @ ground
    pixel = (uvw[:2] / uvw[2]).T
    angle = explained.headings.angle[good]
    cos, sin = np.cos(angle), np.sin(angle)
    shown = np.linalg.inv(_to_ground(found, found.x, pixel))
    value, vector = np.linalg.eigh(found.covariance)
    total = np.zeros(2)
    for step in (vector * np.sqrt(np.maximum(value, 0.0))).T:
        turned = _to_ground(found, found.x + STEP * step, pixel) @ shown
        ahead = np.einsum("nij,nj->ni", turned, np.column_stack((cos, sin)))
        length = np.hypot(ahead[:, 0], ahead[:, 1])
        width = np.abs(np.linalg.det(turned)) / length
        total += np.array([np.median(np.log(ratio)) / STEP for ratio in (length, width)]) ** 2
    along, across = np.sqrt(total)
    return float(along), float(across)


def _to_ground(found: TrafficCalibration, x: Array, pixel: Array) -> Array:
    """(N, 2, 2) slopes of metres with ideal pixels."""
    plane = projection_matrix(x, found.image_size)[:, [0, 1, 3]]
    return jacobian(np.asarray(np.linalg.inv(plane), np.float64), pixel)


def doubts(found: TrafficCalibration) -> list[str]:
    """Sentences about what is probably wrong, or can't be told from this traffic."""
    said = [_odd_focal(found), _odd_axis(found), _odd_classes(found), _unsure(found)]
    return [sentence for sentence in said if sentence]


def _odd_focal(found: TrafficCalibration) -> str:
    """A given focal length that boxes contradict."""
    given = found.model.focal_px
    if given is None:
        return ""
    known = 1.0 / KNOWN_FOCAL_SIGMA**2
    boxes = 1.0 / max(float(found.covariance[FOCAL, FOCAL]), 1e-12) - known
    if boxes <= 0.0:
        return ""
    # The result lies between the given one and that of the boxes, as their information weighs.
    pulled = float(found.x[FOCAL]) - float(np.log(given / found.image_size[0]))
    off = pulled * (boxes + known) / boxes
    if abs(off) * np.sqrt(boxes) < FOCAL_SIGMAS:
        return ""
    return (
        f"Doubtful: the given focal length, {given:.0f} px; by the boxes it would be about "
        f"{given * np.exp(np.clip(off, -3.0, 3.0)):.0f} px. Is it of this zoom and image size?"
    )


def _odd_axis(found: TrafficCalibration) -> str:
    """A principal point that is not in the middle: of a cut image."""
    lens = found.lens
    if lens is None:
        return ""
    width, height = found.image_size
    off = max(abs(lens.cx - width / 2), abs(lens.cy - height / 2))
    if off < OFF_AXIS * width:
        return ""
    return (
        f"Doubtful: the lens has its axis at ({lens.cx:.0f}, {lens.cy:.0f}), {off:.0f} px from the "
        "image's middle, where this calibration has it: of a cut or digitally zoomed image, tilt "
        "and focal length are wrong."
    )


def _odd_classes(found: TrafficCalibration) -> str:
    """A detector that takes cars for buses: everything is then 2.5 times too large."""
    group = found.samples.group
    buses = int((group == BUS).sum())
    if buses < FEW_BUSES or buses < BUSES * len(group):
        return ""
    return (
        f"Doubtful: {buses} of {len(group)} vehicles are called buses. If they are cars, all "
        "distances are two to three times too long: check the detector's classes (--classes)."
    )


def _unsure(found: TrafficCalibration) -> str:
    """Traffic that leaves distances along the road uncertain."""
    along, _ = scale_sigmas(found)
    if along < UNSURE:
        return ""
    return (
        f"Unsure: this traffic can't tell the focal length better than ± "
        f"{100 * found.sigma(FOCAL):.0f} %, so distances along the road and speeds may be off by "
        f"{100 * along:.0f} % (1σ)."
    )
