"""Where a picture lies on a reference: near where it was, or anywhere."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.view.motion_fit import MotionFit
from geoorbit_ros.view.picture import Grey, Matrix, shifted
from geoorbit_ros.view.reference import Match, Reference, edge_picture

NEAR_PX = 3
"""Search of a picture that has hardly moved since the last one, in pixels of a picture. Chosen:
larger takes more time, smaller loses a swaying camera from one look to the next."""
SHAKING_PX = 6
"""The same of a camera that shakes. Chosen: a sway of four pixels (1-sigma) at 2 Hz moves the
picture of an image 1280 px wide by three pixels from look to look."""
EVERY, SHAKING_EVERY = 2, 3
"""One of so many patches is looked for at each look. Chosen: fewer are 0.1 px less exact in a
single look, of which eight are averaged while the camera is steady, and take less time."""
LEAST_PART = 18
"""Patches of which a part must have as many, so that it is enough. Chosen: twice what a motion
needs at least; more looks for all of them in poor pictures, fewer loses the view behind a lorry."""
ENOUGH_SHARE = 0.5
"""Where a smaller share of a part is found, the others are looked for, too. Chosen: dense traffic
hides more, and then each patch counts; larger takes more time in rain."""
FAR_PX = 10
"""Search about a rough guess. Chosen: a turn of one degree moves the corners by six pixels."""
SURE_SHARE = 0.25
"""Least share of the patches that must agree on a motion found anew. Chosen: larger does not find
the view behind dense traffic, smaller takes a fence for the next one."""
EDGE_SIGMA_FACTOR = 1.5
"""Edges of another light or camera mode lie elsewhere by so much more. Chosen, not measured."""
FEATURES = 800
"""Corners described by ORB (Rublee et al. 2011) in each picture. Chosen: more take more time."""
RATIO = 0.8
"""A description's best partner must be this much nearer than the second (Lowe 2004, figure 11)."""
ROUGH_PX = 4.0
"""Tolerance of descriptions, whose corners lie on coarser pictures."""


def follow(
    reference: Reference,
    picture: Grey,
    last: Matrix,
    *,
    turn: int | None = None,
    shaking: bool = False,
) -> Match | None:
    """The motion of a picture that has moved a little since the last one.

    A part of the patches is looked for, another one at each look; all of them where few are found.

    Args:
        reference: The view.
        picture: The picture.
        last: Where the last one was.
        turn: Number of the look; None: look for all patches.
        shaking: Whether it may have moved by a swing.
    """
    radius, every = (SHAKING_PX, SHAKING_EVERY) if shaking else (NEAR_PX, EVERY)
    fit = None
    if turn is not None and len(reference.points) >= LEAST_PART * every:
        fit = reference.match(picture, last, radius, every=every, first=turn % every)
    if fit is None or fit.share < ENOUGH_SHARE:
        fit = reference.match(picture, last, radius)
    return None if fit is None else _match(fit)


def find(reference: Reference, picture: Grey, last: Matrix, *, thorough: bool) -> Match | None:
    """The motion of a picture that may have moved anywhere.

    Args:
        reference: The view.
        picture: The picture.
        last: Where it was.
        thorough: Also compare descriptions of corners, and edges: tens of milliseconds.

    Returns:
        None where the picture does not show the view, as far as can be seen.
    """
    for guess in _guesses(reference, picture, last, thorough=thorough):
        if (match := _settle(reference, picture, guess)) is not None:
            return match
    if not thorough:
        return None
    edges, now = reference.edges, edge_picture(picture)
    for guess in (last, _shift(edges.picture, now)):
        if (match := _settle(edges, now, guess)) is not None:
            sigma_px = EDGE_SIGMA_FACTOR * match.sigma_px
            return Match(match.motion, sigma_px, match.inliers, match.share)
    return None


def _guesses(
    reference: Reference, picture: Grey, last: Matrix, *, thorough: bool
) -> Iterator[Matrix]:
    yield last
    yield _shift(reference.picture, picture)
    if thorough and (guess := _by_descriptions(reference.picture, picture)) is not None:
        yield guess


def _settle(reference: Reference, picture: Grey, guess: Matrix) -> Match | None:
    """From a rough guess to the motion."""
    rough = reference.match(picture, guess, FAR_PX)
    if rough is None or rough.share < SURE_SHARE:
        return None
    fine = rough
    for _ in range(2):  # the parabola errs less the nearer the guess is
        fine = reference.match(picture, fine.motion, NEAR_PX) or fine
    return _match(fine) if fine.share >= SURE_SHARE else None


def _match(fit: MotionFit) -> Match:
    return Match(fit.motion, fit.sigma_px, fit.inliers, fit.share)


def _shift(then: Grey, now: Grey) -> Matrix:
    """The shift by phase correlation of halved pictures without their slow brightness."""
    a, b = _halved(then), _halved(now)
    (right, down), _ = cv2.phaseCorrelate(a, b, _window(a.shape[1], a.shape[0]))
    return shifted(2.0 * right, 2.0 * down)


def _halved(picture: Grey) -> NDArray[np.float32]:
    size = (picture.shape[1] // 2, picture.shape[0] // 2)
    half = cv2.resize(picture, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    return np.asarray(half - cv2.GaussianBlur(half, (0, 0), 12.0), np.float32)


@lru_cache(maxsize=4)
def _window(width: int, height: int) -> NDArray[np.float32]:
    return np.asarray(cv2.createHanningWindow((width, height), cv2.CV_32F), np.float32)


def _by_descriptions(then: Grey, now: Grey) -> Matrix | None:
    """Turn, zoom and shift of corners that look alike, wherever they are."""
    orb = cv2.ORB.create(FEATURES, fastThreshold=8)
    (old, a), (new, b) = orb.detectAndCompute(then, None), orb.detectAndCompute(now, None)
    if a is None or b is None or len(b) < 2:
        return None
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(a, b, k=2)
    good = [best for best, second in pairs if best.distance < RATIO * second.distance]
    if len(good) < 8:
        return None
    before = np.array([old[m.queryIdx].pt for m in good])
    after = np.array([new[m.trainIdx].pt for m in good])
    found, _ = cv2.estimateAffinePartial2D(before, after, ransacReprojThreshold=ROUGH_PX)
    return None if found is None else np.vstack([found, [0.0, 0.0, 1.0]])
