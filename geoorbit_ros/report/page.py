"""The lane report: one HTML page without other files, for a traffic engineer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.camera_pose import recover_pose
from geoorbit_ros.calibration.homography import Homography
from geoorbit_ros.calibration.point_advice import advise
from geoorbit_ros.core.errors import CalibrationError
from geoorbit_ros.core.input_report import InputReport
from geoorbit_ros.core.lanes import Lane, LaneMap
from geoorbit_ros.metrics.score import score_lanes
from geoorbit_ros.report.document import (
    bullets,
    document,
    figure,
    remarks_section,
    section,
)
from geoorbit_ros.report.recording import Recording
from geoorbit_ros.report.tables import (
    boundary_table,
    calibration_table,
    facts,
    lane_table,
    score_table,
)
from geoorbit_ros.report.text import (
    compass,
    count,
    number,
    score_sentences,
    shift_sentences,
    summary_sentence,
    tentative_sentences,
    view_sentences,
)
from geoorbit_ros.report.traffic.content import TrafficContent
from geoorbit_ros.report.traffic.page import traffic_sections
from geoorbit_ros.report.views import image_view, map_view, section_view

LANE_NOTE = (
    '<p class="note">The id of a lane stays the same, and the drawings show it. The lane number '
    "counts from the outer edge of the road (1) to the middle, in each direction.</p>"
)
"""Below the table of lanes."""


@dataclass(frozen=True, slots=True)
class ReportInput:
    """Everything the page shows.

    Attributes:
        camera_id: Name of the camera.
        lane_map: The lanes found.
        recording: The vehicles' ground tracks.
        homography: The camera's calibration.
        image_size: (width, height) in pixels.
        provenance: Names and values: how the map was made.
        truth: True lanes, when known.
        remarks: What was done with the inputs, and what speaks against them.
        image: (H, W, 3) uint8 BGR, the camera's view; None: not known.
        traffic: What was counted in the lanes; None: there are no lanes.
    """

    camera_id: str
    lane_map: LaneMap
    recording: Recording
    homography: Homography
    image_size: tuple[int, int]
    provenance: Sequence[tuple[str, str]]
    truth: Sequence[Lane] | None = None
    remarks: Sequence[InputReport] = ()
    image: NDArray[np.uint8] | None = None
    traffic: TrafficContent | None = None


def write_report(path: Path, content: ReportInput) -> None:
    """Write the page; the same input gives the same bytes."""
    path.write_text(report_html(content), encoding="utf-8")


def report_html(content: ReportInput) -> str:
    """The page as text."""
    lanes = content.lane_map.lanes
    title = f"Lanes of {content.camera_id}"
    told = [
        sentence
        for sentences in (view_sentences, shift_sentences, tentative_sentences)
        for sentence in sentences(content.lane_map)
    ]
    parts = [
        f"<header><p class='kicker'>Lane report</p><h1>{escape(title)}</h1>"
        f"<p class='lead'>{escape(summary_sentence(lanes))}</p>{_tiles(content)}</header>",
        remarks_section(content.remarks),
        section("Lanes", lane_table(lanes) + bullets(told) + LANE_NOTE + _boundaries(lanes)),
        _drawings(content),
        _histograms(content),
    ]
    if content.traffic is not None:
        parts.append(f'<div class="traffic">{traffic_sections(content.traffic)}</div>')
    if content.truth is not None:
        score = score_lanes(lanes, content.truth)
        parts.append(
            section(
                "Compared with the true lanes", bullets(score_sentences(score)) + score_table(score)
            )
        )
    parts.append(_calibration(content))
    parts.append(section("How this was made", facts(content.provenance)))
    return document(title, "".join(parts))


def _boundaries(lanes: Sequence[Lane]) -> str:
    """What bounds each lane, where an image was looked at for painted lines."""
    if all(lane.left_edge is None and lane.right_edge is None for lane in lanes):
        return ""
    return f"<h3>What bounds each lane</h3>{boundary_table(lanes)}"


def _tiles(content: ReportInput) -> str:
    lane_map, recording = content.lane_map, content.recording
    confirmed = len(lane_map.confirmed)
    tentative = len(lane_map.lanes) - confirmed
    tiles = [
        (str(confirmed), "lane confirmed" if confirmed == 1 else "lanes confirmed"),
        (str(tentative), "lane tentative" if tentative == 1 else "lanes tentative"),
        (f"{recording.track_count:,}", "vehicle tracks"),
        (_duration(recording.duration_s), "of traffic"),
    ]
    tiles += [
        (f"{far:.0f} m", "from the camera to the farthest lane seen")
        for far in _range_m(content)[1:]
    ]
    return (
        "<div class='tiles'>"
        + "".join(f"<div><b>{escape(a)}</b><span>{escape(b)}</span></div>" for a, b in tiles)
        + "</div>"
    )


def _drawings(content: ReportInput) -> str:
    paths = content.recording.paths()
    parts = [_map(content, paths)] if content.lane_map.lanes else []
    camera = image_view(
        content.lane_map, paths, content.homography, content.image_size, content.image
    )
    caption = "The same lanes and paths, projected back into the image. Crosses: control points."
    near_far = _range_m(content)
    if near_far:
        sees = f"Lanes are seen from {near_far[0]:.0f} to {near_far[1]:.0f} m from the camera."
        caption = f"{sees} {caption}"
    kind = "camera" if content.image is None else "camera photo"
    parts.append(section("The camera's view", figure(camera.markup(), caption, kind)))
    return "".join(parts)


def _map(content: ReportInput, paths: Sequence[NDArray[np.float64]]) -> str:
    drawing, frame, drawn = map_view(content.lane_map, paths, content.truth or ())
    shown = count(len(paths), "vehicle path")
    if drawn < len(paths):
        shown = f"{drawn} of {shown}"
    caption = [
        f"{shown}, coloured by direction of travel; a track with a gap is drawn as several. "
        "Filled lanes are confirmed, dashed ones tentative; arrows show the direction of travel.",
    ]
    if frame.stretch > 1:
        caption.append(
            f"Up and down the page, lengths are drawn {frame.stretch:.0f} times as large as from "
            "left to right."
        )
    if len(content.lane_map.visible_m):
        caption.append("On the shaded ground, neighbouring lanes can be told apart.")
    if content.truth:
        caption.append("Thin lines are the true lanes.")
    return section("Map", figure(drawing.markup(), " ".join(caption), "map"))


def _histograms(content: ReportInput) -> str:
    sections = content.lane_map.cross_sections
    if not sections:
        return ""
    figures = [
        f"<h3>Towards {compass(s.heading_deg)}, {s.heading_deg:.0f}°: "
        f"{count(len(s.peak_m), 'peak')}</h3>"
        + figure(section_view(s, content.lane_map).markup(), "", "histogram")
        for s in sections
    ]
    note = (
        "<p>Where across the road the vehicles drive, one drawing per direction of travel, at the "
        "place where most vehicles were seen. Dashed lines are the middles of lanes. The "
        "figures between them are the distances from lane to lane.</p>"
    )
    return section("Across the road", note + "".join(figures))


def _calibration(content: ReportInput) -> str:
    residual = content.homography.residual
    used = residual.inlier
    error_m = residual.ground_error_m[used]
    sentence = (
        f"{int(used.sum())} of {count(len(used), 'control point')} used. Their median error is "
        f"{number(float(np.median(residual.pixel_error[used])))} px in the image and "
        f"{number(float(np.median(error_m)), 3)} m on the road; the largest is "
        f"{number(float(error_m.max()), 3)} m."
    )
    sentence += _more_points(content)
    return section(
        "Calibration",
        f"<p>{escape(sentence)}</p><details><summary>Every control point</summary>"
        f"{calibration_table(content.homography)}</details>",
    )


def _more_points(content: ReportInput) -> str:
    """How well clicked points fix the road, and where one more helps most; empty for others."""
    if content.homography.points.facts.scale_sigma > 0.0:
        return " They were computed from traffic; nobody measured them."
    try:
        advice = advise(content.homography, content.image_size)
    except CalibrationError:  # no road near the camera is in view
        return ""
    more = advice.next_sentence()
    return f" The road in view is known to ± {advice.sigma_m:.2f} m. {more[0].upper()}{more[1:]}."


def _range_m(content: ReportInput) -> tuple[float, ...]:
    """Nearest and furthest ground from the camera where lanes are seen; empty when unknown."""
    try:
        pose = recover_pose(content.homography, content.image_size)
    except CalibrationError:
        return ()
    ground = content.lane_map.visible_m
    if not len(ground):
        lines = [lane.centerline_m for lane in content.lane_map.confirmed]
        ground = np.vstack(lines) if lines else ground
    if not len(ground):
        return ()
    distance = np.hypot(*(ground - pose.position_m[:2]).T)
    return float(distance.min()), float(distance.max())


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
