"""Holds a camera's inputs against each other: calibration, image size, boxes and their times.

Each may be right on its own and still not belong to the others: control points of another
resolution, a frame number in place of the time, the corner of a box in place of its middle. What
speaks against them is said, and lanes are not confirmed on such ground.
"""

from __future__ import annotations

from bisect import bisect_left

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.camera_pose import CameraPose, recover_pose
from geoorbit_ros.calibration.flatness import Stretch
from geoorbit_ros.calibration.plane import Homography
from geoorbit_ros.calibration.point_advice import point_remarks
from geoorbit_ros.calibration.traffic_findings import (
    COLUMNS,
    TIME,
    SeenTraffic,
    border_finding,
    boxes_as_numbers,
    on_the_road,
    other_size_finding,
    seen_traffic,
    size_finding,
    sky_finding,
    speed_finding,
    stretches_of,
)
from geoorbit_ros.core.errors import CalibrationError
from geoorbit_ros.core.input_report import InputReport, Remark, Treatment
from geoorbit_ros.core.tables import FLAG_PREDICTED, VEHICLE_CLASSES, Frames

FAR_OUTSIDE = (0.2, 1.0)
"""Control points that lie these shares of the image's width and height beyond its border, in both
or in one of them, belong to another image. Chosen: larger misses images of other sizes (1080 rows
for 720 are 0.5), smaller doubts points that were projected from a survey into the image (65 px of
1080 are 0.06) and images that were cropped."""
NAMED_POINTS = 10
"""So many dropped control points are named, and the rest are counted."""
SAMPLE_S = 0.1
"""Data time between two frames that are looked at. Chosen: longer misses fast vehicles at the
image's border (a car crosses it in 0.12 s at 38 m/s), shorter costs time."""
MAX_ROWS = 8_000
"""Rows that are remembered, the latest: minutes of traffic. Chosen: more costs time and memory."""
JUDGED_AGAIN = 0.5
"""Traffic is judged again when this share of its rows is new. Chosen: larger says it later, smaller
costs time."""
JUDGE_S = 2.0
"""Data time between two judgements at least; lanes are derived every five seconds."""
JUDGED_LATER = 0.1
"""Traffic is judged again after this share of the data time so far: inputs that don't belong to
each other don't from the beginning. Chosen: larger says it later, smaller costs time."""
LONGEST_JUDGE_S = 120.0
"""But traffic that is enough is judged so often at least. Chosen: as the share."""


def calibration_report(
    homography: Homography, image_size: tuple[int, int] | None = None
) -> InputReport:
    """What is to be said about the control points, the fit, and the image they belong to.

    Args:
        homography: The road plane.
        image_size: (width, height) of the image in pixels; None where it isn't known.
    """
    points, residual = homography.points, homography.residual
    read = points.report
    report = InputReport(points.place, "control points", read.total or len(points))
    report.remarks += read.remarks
    dropped = np.flatnonzero(~residual.inlier)
    if len(dropped):
        shown = [
            f"line {points.line_number[k]}: {residual.pixel_error[k]:.0f} px, "
            f"{residual.ground_error_m[k]:.1f} m"
            for k in dropped[:NAMED_POINTS]
        ]
        more = f" and {len(dropped) - NAMED_POINTS} more" if len(dropped) > NAMED_POINTS else ""
        text = f"they disagree with the others ({'; '.join(shown)}{more})"
        report.add(Treatment.LEFT_OUT, len(dropped), text)
    report.remarks += homography.remarks
    if not points.facts.north_known:
        text = "their north is not true north: places and directions on the map are not right"
        report.note(Treatment.NOTED, text)
    known_size = image_size or points.image_size
    if known_size is not None:
        report.remarks += _focal_doubts(homography, known_size)
        report.remarks += point_remarks(homography, known_size)
    if image_size is None:
        return report
    size = np.array(image_size, dtype=np.float64)
    beyond = np.maximum(-points.pixel, points.pixel - size) / size
    outside = (beyond > 0.0).any(axis=1) & residual.inlier
    if outside.any():
        width, height = image_size
        reach = points.pixel[residual.inlier].max(axis=0)
        far = beyond[residual.inlier].max(axis=0)
        if far.min() > FAR_OUTSIDE[0] or far.max() > FAR_OUTSIDE[1]:
            text = (
                f"the image is {width}x{height}, but the control points reach pixel "
                f"({reach[0]:.0f}, {reach[1]:.0f}): are they of this image, in this size?"
            )
            report.note(Treatment.DOUBTFUL, text)
        else:
            text = f"outside the image of {width}x{height}, used all the same"
            k = int(np.argmax(outside))
            u, v = points.pixel[k]
            example = f"line {points.line_number[k]}: pixel ({u:.0f}, {v:.0f})"
            report.add(Treatment.NOTED, int(outside.sum()), text, example)
    return report


def _focal_doubts(homography: Homography, image_size: tuple[int, int]) -> list[Remark]:
    """What is to be said where the road doesn't fit the focal length that is given."""
    lens = homography.lens
    if lens is None or not lens.focal_known:
        return []
    try:
        pose = recover_pose(homography, image_size)
    except CalibrationError:
        return []
    if pose.focal_px == lens.fx:
        return []
    text = (
        f"the given focal length of {lens.fx:.0f} px does not fit the control points, which show "
        f"{pose.focal_px:.0f} ± {pose.focal_sigma_px:.0f} px: "
        "is the lens this camera's, at this zoom?"
    )
    return [Remark(Treatment.DOUBTFUL, 0, text)]


class TrafficCheck:
    """Looks at a camera's traffic now and then: is it what these inputs together can show?

    Only the past counts, by the frames' stamps: the same frames give the same findings.

    Args:
        homography: The road plane.
        image_size: (width, height) of the image in pixels.
        pose: The camera; None where its height is not known, and nothing is said about sizes.
        pose_error: Why it isn't.

    Attributes:
        findings: What speaks against the inputs, as of the last judgement.
        bends: Where the road was known not to be the plane, from which frame of the latest block
            on.
    """

    def __init__(
        self,
        homography: Homography,
        image_size: tuple[int, int],
        pose: CameraPose | None,
        pose_error: CalibrationError | None = None,
    ) -> None:
        self._homography, self._image_size = homography, image_size
        self._pose, self._pose_error = pose, pose_error
        self.reset()

    def reset(self) -> None:
        """Forget all traffic, and what was found in it."""
        self.findings: tuple[Remark, ...] = ()
        self.bends: list[tuple[int, list[Stretch]]] = []
        self._stretches: list[Stretch] = []
        self._times: list[float] = []
        self._new: list[NDArray[np.float64]] = []
        self._seen = np.empty((0, COLUMNS))
        self._new_rows = 0
        self._sampled_ns = self._judge_ns = -(1 << 62)
        self._first_ns: int | None = None

    @property
    def doubtful(self) -> bool:
        """Whether a finding speaks against trusting what is made of this traffic."""
        return any(found.treatment is Treatment.DOUBTFUL for found in self.findings)

    def add(self, frames: Frames) -> NDArray[np.bool_]:
        """Take frames of `PIXEL_TRACK_DTYPE`; judge whenever enough is new.

        Returns:
            (F,) `doubtful` as of each frame.
        """
        doubtful = np.full(len(frames), self.doubtful)
        self.bends = [(0, self._stretches)]
        looked = self._sample(frames)
        if not looked:
            return doubtful
        boxes, first = _vehicles_as_numbers(frames, looked)
        done = 0
        for k, frame in enumerate(looked):
            stamp_ns = int(frames.stamp_ns[frame])
            self._times.append(stamp_ns / 1e9)
            new_rows = self._new_rows + first[k + 1] - first[done]
            known = min(len(self._seen) + new_rows, MAX_ROWS)
            enough = new_rows >= JUDGED_AGAIN * known
            if enough and stamp_ns >= self._judge_ns:
                self._judge_ns = stamp_ns + self._pause_ns(stamp_ns)
                self._take(boxes[first[done] : first[k + 1]])
                done = k + 1
                self.judge()
                doubtful[frame:] = self.doubtful
                self.bends.append((frame, self._stretches))
        self._take(boxes[first[done] :])
        return doubtful

    def _sample(self, frames: Frames) -> list[int]:
        """Frames with rows, `SAMPLE_S` apart."""
        some = (frames.offset[1:] > frames.offset[:-1]).nonzero()[0]
        stamps, looked, k = frames.stamp_ns[some].tolist(), [], 0
        while (k := bisect_left(stamps, self._sampled_ns + SAMPLE_S * 1e9, k)) < len(stamps):
            self._sampled_ns = stamps[k]
            looked.append(int(some[k]))
        return looked

    def _take(self, boxes: NDArray[np.float64]) -> None:
        self._new.append(boxes)
        self._new_rows += len(boxes)

    def _pause_ns(self, stamp_ns: int) -> int:
        """How long the next judgement is not due."""
        if self._first_ns is None:
            self._first_ns = stamp_ns
        so_far_s = (stamp_ns - self._first_ns) / 1e9
        return int(1e9 * min(max(JUDGE_S, JUDGED_LATER * so_far_s), LONGEST_JUDGE_S))

    def judge(self) -> tuple[Remark, ...]:
        """The findings on all traffic that is remembered, now."""
        self._remember()
        if len(self._seen):
            traffic = seen_traffic(self._seen, self._times)
            found = [
                *sky_finding(traffic),
                *speed_finding(traffic),
                *border_finding(traffic, self._image_size, self._homography, self._pose),
            ]
            if self._pose is not None:
                found += size_finding(traffic, self._image_size, self._homography, self._pose)
                self._stretches = [k for k in self._bends(traffic, self._pose) if k.clear]
                height_m = float(self._pose.position_m[2])
                texts = [stretch.sentence(height_m) for stretch in self._stretches]
                found += [Remark(Treatment.NOTED, 0, text) for text in texts]
            elif self._pose_error is not None and traffic.solid.any():
                text = (
                    "vehicles are taken to stand where their boxes end, as the camera's height is "
                    f"not known: found {self._pose_error.found}, expected "
                    f"{self._pose_error.expected}"
                )
                found += other_size_finding(traffic, self._image_size, self._homography)
                found.append(Remark(Treatment.NOTED, 0, text))
            self.findings = tuple(found)
        return self.findings

    def stretches(self) -> list[Stretch]:
        """How the road bends, by all traffic that is remembered; also where it does not clearly."""
        self._remember()
        if self._pose is None or not len(self._seen):
            return []
        return self._bends(seen_traffic(self._seen, self._times), self._pose)

    def _bends(self, traffic: SeenTraffic, pose: CameraPose) -> list[Stretch]:
        return stretches_of(traffic, self._image_size, self._homography, pose)

    def _remember(self) -> None:
        """Put the new rows on the road, and forget the oldest frames."""
        if self._new:
            new = on_the_road(np.concatenate(self._new), self._homography)
            self._seen = np.concatenate([self._seen, new])
        if (more := len(self._seen) - MAX_ROWS) > 0:
            times = self._seen[:, TIME]
            self._seen = self._seen[np.searchsorted(times, times[more - 1]) :]
            self._times = self._times[bisect_left(self._times, self._seen[0, TIME]) :]
        self._new, self._new_rows = [], 0


def _vehicles_as_numbers(
    frames: Frames, looked: list[int]
) -> tuple[NDArray[np.float64], list[int]]:
    """Observed vehicles (N, 8) of the frames `looked` (K), and where each frame's begin (K + 1)."""
    count = np.diff(frames.offset)[looked]
    frame = np.repeat(looked, count)
    begin = np.cumsum(count) - count
    row = frames.offset[frame] + np.arange(len(frame)) - np.repeat(begin, count)
    rows = frames.rows.take(row)
    use = (rows["flags"] & FLAG_PREDICTED) == 0
    use &= np.logical_or.reduce([rows["class_id"] == kind for kind in VEHICLE_CLASSES])
    for name in ("x", "y", "width", "height"):
        use &= np.isfinite(rows[name])
    boxes = boxes_as_numbers(frames.stamp_ns[frame[use]] / 1e9, rows.take(use.nonzero()[0]))
    return boxes, np.append(0, np.cumsum(use))[np.append(begin, len(frame))].tolist()
