"""Finds the rigid movement that lays a camera's map frame on a network.

A camera's control points displace all of its lanes alike, and a map can be displaced as a whole,
each by a metre or more. One rotation and one translation lay the detected lanes on the network's:
iteratively reweighted least squares with Tukey's biweight (Huber 1981, "Robust Statistics") on the
distances across the lanes, from several starts, because lanes repeat every 3.5 m.

The rotation is left out unless it is significant, because a patch applies it to roads beyond the
view, too: it must exceed three times its error (backward elimination, Draper and Smith 1998,
"Applied Regression Analysis", ch. 15), and move the ends of the lanes seen by more than the usual
error of control points.

Of the results, and of no movement at all, the one is taken that leaves the fewest errors in the map
(Rissanen 1978, minimum description length). A movement counts as one error (as two beyond half a
lane), and so does every edge with a lane out of its place, and every lane that the map lacks. So a
map in which one of two roads is displaced is not aligned to that road.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import NoTrafficError
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.mapcheck.offsets import LaneSamples, Offsets, lanes_near, offsets, sample_lines
from geoorbit_ros.roadnet.network import RoadNetwork

SEARCH_M, SEARCH_STEP_M = 4.0, 0.25
"""Shifts to start from: up to so far, on a grid of this step. Chosen: beyond a lane's width a shift
can't be told from the next lane; a finer grid costs time."""
SHIFT_PRIOR_M, TURN_PRIOR_RAD = 2.0, np.radians(0.5)
"""1-sigma of the shift and the rotation before any lane is compared. Chosen: larger lets few lanes
move the map far, smaller holds back real displacements."""
SCALE_M = 0.6
"""Residuals beyond this have no weight (Tukey's biweight), so that a road displaced by a metre does
not count (ADR 0029). Chosen: larger lets wrong lanes pull, smaller loses curved ones."""
BLOCK_M = 50.0
"""Over this length the errors of a detected lane are the same: one observation. Chosen: larger
makes the alignment's error larger, smaller makes chance significant."""
LANE_SIGMA_M = 0.15
"""1-sigma of a lane without an error of its own. Chosen: larger gives such lanes less weight than
the others, smaller more."""
SHAPE_M = 0.1
"""1-sigma of the shapes of lanes and map, which more vehicles do not reduce. Chosen: larger hides
small displacements, smaller makes those of straight pieces significant."""
OBSERVABLE_M = 0.5
"""A direction whose 1-sigma is larger is reported as not observed. Chosen: larger moves the map
along lanes that are almost straight, smaller leaves a real shift out."""
SIGNIFICANT_M, SIGNIFICANT_SIGMAS = 0.3, 3.0
"""Least shift, and least movement of the ends of the lanes by the rotation, that counts; and how
many times its own error. Control points err by 0.3 m: one scene's camera, off by 0.23 degrees with
an error of 0.13, turned a map by 1.3 m beyond its view (ADR 0029)."""
WRONG_M = 0.4
"""A lane this far from its place counts as an error of the map when movements are compared. Chosen:
a little above the tolerance of a lane (`discrepancies.SHIFT_M`); smaller counts noise."""
LANE_GATE_M = 1.75
"""Half a lane of 3.5 m: farther, a lane is easily taken for its neighbour."""
STARTS = 6
"""Shifts that the fit starts from. Chosen: more cost time, fewer can miss the right one where lanes
repeat."""
START_GAP_M = 0.75
"""Least distance between two of them. Chosen: nearer ones end in the same fit."""
ITERATIONS = 15
"""Most steps of the least squares, which end before where a step changes less than 1e-4. Chosen:
more cost time."""


@dataclass(frozen=True, slots=True)
class Alignment:
    """Movement of a camera's points onto the network: `centre + R(turn) (p - centre) + shift`.

    Attributes:
        centre_m: (2,) middle of the lanes, in the map frame.
        shift_m: (2,) translation there; zero along a direction that is not observed.
        turn_rad: Rotation, counter-clockwise.
        covariance: (3, 3) of shift and turn, m and rad; along a direction that is not observed,
            that of the prior.
        unobserved: (2,) unit vector of the direction along which nothing is known, as all lanes
            run along it; zero when both directions are.
        residual_m: Median distance of the lanes from the network's afterwards.
        lanes: How many confirmed lanes it was fitted to.
    """

    centre_m: NDArray[np.float64]
    shift_m: NDArray[np.float64]
    turn_rad: float
    covariance: NDArray[np.float64]
    unobserved: NDArray[np.float64]
    residual_m: float
    lanes: int

    def points(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (N, 2) of the camera's map, laid on the network."""
        return np.asarray(self.centre_m + self.shift_m + _turned(xy - self.centre_m, self.turn_rad))

    def inverse_points(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (N, 2) of the network, where the camera sees them."""
        return np.asarray(
            self.centre_m + _turned(xy - self.centre_m - self.shift_m, -self.turn_rad)
        )

    @property
    def size_m(self) -> float:
        """Length of the shift."""
        return float(np.hypot(*self.shift_m))

    @property
    def sigma_m(self) -> float:
        """1-sigma error of the shift in its own direction."""
        unit = self.shift_m / max(self.size_m, 1e-9)
        if self.size_m < 1e-9:
            values = np.linalg.eigvalsh(self.covariance[:2, :2])
            return float(np.sqrt(values[0]))
        return float(np.sqrt(unit @ self.covariance[:2, :2] @ unit))

    @property
    def significant(self) -> bool:
        """Whether camera and map differ by more than the errors explain."""
        return self.size_m > max(SIGNIFICANT_M, SIGNIFICANT_SIGMAS * self.sigma_m)

    def about_origin(
        self, centre_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The same movement as a turn about the origin: shift (2,) and covariance (3, 3).

        Args:
            centre_m: (2,) where `centre_m` lies from that origin.
        """
        x, y = centre_m
        shift = centre_m + self.shift_m - _turned(centre_m, self.turn_rad)
        step = np.array([[1.0, 0.0, y], [0.0, 1.0, -x], [0.0, 0.0, 1.0]])
        return shift, np.asarray(step @ self.covariance @ step.T)

    def values(self) -> dict[str, float]:
        """Rounded figures for reports."""
        return {
            "shift_east_m": round(float(self.shift_m[0]), 3),
            "shift_north_m": round(float(self.shift_m[1]), 3),
            "turn_deg": round(float(np.degrees(self.turn_rad)), 3),
            "sigma_m": round(self.sigma_m, 3),
        }

    @property
    def applied(self) -> Alignment:
        """The same movement where it is significant, else none."""
        if self.significant:
            return self
        return replace(self, shift_m=np.zeros(2), turn_rad=0.0)


@dataclass(frozen=True, slots=True)
class _Problem:
    points: LaneSamples
    near: Offsets
    edge: NDArray[np.int64]
    weight: NDArray[np.float64]
    centre: NDArray[np.float64]
    lanes: int

    def rows(self, lane: NDArray[np.int64]) -> NDArray[np.float64]:
        """(N, 3) what a shift and a turn do to the offset from each point's lane."""
        at = np.arange(len(lane))
        normal = self.near.normal[at, lane]
        arm = self.points.xy - self.centre
        turn = normal[:, 1] * arm[:, 0] - normal[:, 0] * arm[:, 1]
        return np.column_stack((normal, turn))

    def moved(self, move: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, L) offsets after a movement; the lanes are straight as far as it goes."""
        arm = self.points.xy - self.centre
        step = move[:2] + move[2] * np.column_stack((-arm[:, 1], arm[:, 0]))
        return np.asarray(self.near.offset_m + np.einsum("nlk,nk->nl", self.near.normal, step))


def align(lanes: Sequence[Lane], network: RoadNetwork) -> Alignment:
    """Find the movement that lays detected lanes on a network.

    Args:
        lanes: In the map frame; only confirmed ones are used.
        network: In the same frame.

    Raises:
        NoTrafficError: No confirmed lane.
        RoadNetworkError: The network lies elsewhere.
    """
    confirmed = [lane for lane in lanes if lane.status == "confirmed"]
    if not confirmed:
        found = f"{len(lanes)} lanes, none confirmed"
        raise NoTrafficError("detected lanes", found, "confirmed lanes: more traffic")
    number = lanes_near(network, confirmed)
    problem = _problem(confirmed, network, number)
    moves = [np.zeros(3), *(_fitted(problem, start) for start in _starts(problem))]
    return min(
        (_result(problem, move) for move in moves),
        key=lambda result: _cost(problem, result),
    )


def _problem(lanes: Sequence[Lane], network: RoadNetwork, number: NDArray[np.int64]) -> _Problem:
    points = sample_lines([lane.centerline_m for lane in lanes])
    near = offsets(points, [network.line(int(k)) for k in number])
    sigma = np.array([lane.sigma_m for lane in lanes])
    sigma = np.hypot(np.where(np.isfinite(sigma), sigma, LANE_SIGMA_M), SHAPE_M)
    weight = points.step_m / BLOCK_M / sigma[points.lane] ** 2
    names = sorted({network.edge_id[int(k)] for k in number})
    edge = np.array([names.index(network.edge_id[int(k)]) for k in number])
    return _Problem(points, near, edge, weight, points.xy.mean(axis=0), len(lanes))


def _starts(problem: _Problem) -> list[NDArray[np.float64]]:
    """Shifts to start from: none, and those after which most lanes lie on lanes."""
    side = np.arange(-SEARCH_M, SEARCH_M + 1e-9, SEARCH_STEP_M)
    shifts = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    shifts = shifts[np.hypot(*shifts.T) <= SEARCH_M]
    thin = slice(None, None, 3)
    near = problem.near.offset_m[thin]
    score = np.zeros(len(shifts))
    for k, shift in enumerate(shifts):
        moved = np.abs(near + problem.near.normal[thin] @ shift)
        score[k] = problem.weight[thin] @ _biweight(moved.min(axis=1, initial=np.inf))
    # Nearly equal ones: the smaller shift.
    order = np.argsort(-score + 1e-3 * score.max() * np.hypot(*shifts.T), kind="stable")
    starts = [np.zeros(2)]
    for k in order.tolist():
        if len(starts) < STARTS and all(np.hypot(*(shifts[k] - s)) >= START_GAP_M for s in starts):
            starts.append(shifts[k])
    return [np.append(start, 0.0) for start in starts]


def _fitted(problem: _Problem, start: NDArray[np.float64]) -> NDArray[np.float64]:
    """Shift and turn (3,) from a start, the turn only where it is significant."""
    move = _refined(problem, start)
    sigma = float(np.sqrt(_result(problem, move).covariance[2, 2]))
    reach_m = float(np.hypot(*(problem.points.xy - problem.centre).T).max())
    if abs(move[2]) > max(SIGNIFICANT_M / reach_m, SIGNIFICANT_SIGMAS * sigma):
        return move
    return _refined(problem, np.append(move[:2], 0.0), turns=False)


def _refined(
    problem: _Problem, start: NDArray[np.float64], turns: bool = True
) -> NDArray[np.float64]:
    move, free = start, slice(3 if turns else 2)
    for _ in range(ITERATIONS):
        lane, residual = _nearest(problem, move)
        rows = problem.rows(lane)[:, free]
        weight = problem.weight * _biweight(np.abs(residual))
        fixed = np.where(np.isfinite(residual), problem.near.offset_m[_rows(lane), lane], 0.0)
        change = np.zeros(3)
        change[free] = np.linalg.solve(
            rows.T @ (weight[:, None] * rows) + _prior()[free, free], -(rows.T @ (weight * fixed))
        )
        if np.abs(change - move).max() < 1e-4:
            break
        move = change
    return move


def _result(problem: _Problem, move: NDArray[np.float64]) -> Alignment:
    lane, residual = _nearest(problem, move)
    good = np.abs(residual) < SCALE_M
    rows = problem.rows(lane)[good]
    weight = problem.weight[good] * _biweight(np.abs(residual[good]))
    covariance = np.asarray(
        np.linalg.inv(rows.T @ (weight[:, None] * rows) + _prior()), dtype=np.float64
    )
    spread = rows[:, :2].T @ (weight[:, None] * rows[:, :2]) / max(weight.sum(), 1e-12)
    values, axes = np.linalg.eigh(spread)
    shape = (axes * (SHAPE_M**2 / np.maximum(values, 1e-6))) @ axes.T
    covariance[:2, :2] += np.where(np.isfinite(shape), shape, 0.0)
    weakest = axes[:, 0]
    unobserved = np.zeros(2)
    shift = move[:2].copy()
    if weakest @ covariance[:2, :2] @ weakest > OBSERVABLE_M**2:
        unobserved = weakest
        shift -= (shift @ weakest) * weakest
        across = np.eye(2) - np.outer(weakest, weakest)
        covariance[:2, :2] = across @ covariance[:2, :2] @ across
        covariance[:2, :2] += SHIFT_PRIOR_M**2 * np.outer(weakest, weakest)
    return Alignment(
        centre_m=problem.centre,
        shift_m=shift,
        turn_rad=float(move[2]),
        covariance=covariance,
        unobserved=unobserved,
        residual_m=float(np.median(np.abs(residual[good]))) if good.any() else float("nan"),
        lanes=problem.lanes,
    )


def _cost(problem: _Problem, result: Alignment) -> tuple[float, float]:
    """How many errors of the map remain after a movement, and how bad the fit is.

    Of movements that leave as many errors, the one that fits best is taken.
    """
    used = result.applied
    lane, residual = _nearest(problem, np.append(used.shift_m, used.turn_rad))
    distance = np.abs(residual)
    # Beyond half a lane, lanes are easily taken for their neighbours.
    errors = float(used.significant) + float(used.size_m > LANE_GATE_M)
    wrong: set[int] = set()
    for k in range(problem.lanes):
        mine = problem.points.lane == k
        beside = mine & (distance <= LANE_GATE_M)
        errors += float(beside.sum() < 0.5 * mine.sum())
        edge = problem.edge[lane]
        for e in np.unique(edge[beside]).tolist():
            there = beside & (edge == e)
            if there.sum() >= 5 and float(np.median(distance[there])) > WRONG_M:
                wrong.add(e)
    _, residual = _nearest(problem, np.append(result.shift_m, result.turn_rad))
    fit = float(problem.weight @ (1.0 - _biweight(np.abs(residual))))
    return errors + len(wrong), fit


def _nearest(
    problem: _Problem, move: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Each point's nearest lane (N,) and the signed offset from it (N,)."""
    moved = problem.moved(move)
    lane = np.argmin(np.abs(moved), axis=1)
    return lane, moved[_rows(lane), lane]


def _rows(lane: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.arange(len(lane))


def _prior() -> NDArray[np.float64]:
    return np.diag([SHIFT_PRIOR_M**-2, SHIFT_PRIOR_M**-2, TURN_PRIOR_RAD**-2])


def _biweight(distance: NDArray[np.float64]) -> NDArray[np.float64]:
    share = np.minimum(distance / SCALE_M, 1.0)
    return np.asarray((1.0 - share**2) ** 2)


def _turned(vector: NDArray[np.float64], angle_rad: float) -> NDArray[np.float64]:
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    return np.asarray(vector @ np.array([[cos, sin], [-sin, cos]]))
