"""The report's tables as HTML."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

import numpy as np

from geoorbit_ros.calibration.homography import Homography
from geoorbit_ros.core.lane_order import lane_numbers, left_to_right
from geoorbit_ros.core.lanes import Lane, LaneEdge
from geoorbit_ros.metrics.lane_score import LaneScore
from geoorbit_ros.report.lane_drawing import direction_groups
from geoorbit_ros.report.text import compass, number


def table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of ready markup; a column name that starts with `>` is aligned to the right."""
    css = ['class="n"' if name.startswith(">") else "" for name in columns]
    head = "".join(
        f'<th scope="col" {c}>{escape(name.lstrip(">"))}</th>'
        for c, name in zip(css, columns, strict=True)
    )
    body = "".join(
        "<tr>" + "".join(f"<td {c}>{cell}</td>" for c, cell in zip(css, row, strict=True)) + "</tr>"
        for row in rows
    )
    return (
        f'<div class="scroll"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def lane_table(lanes: Sequence[Lane]) -> str:
    """One row per lane, by direction and from left to right: what it is and how sure."""
    colour, numbers = direction_groups(lanes), lane_numbers(lanes)
    return table(
        (
            "Lane id",
            ">Lane no.",
            "Status",
            "Direction",
            ">Width, m",
            ">Vehicles",
            "Confidence",
            ">Length, m",
            ">Position ±, m",
        ),
        (
            (
                f'<span class="chip d{colour[lane.lane_id]} {lane.status}">{lane.lane_id}</span>',
                str(numbers[lane.lane_id]),
                lane.status,
                _direction(lane.heading_deg),
                f"{number(lane.width_m)} ± {number(lane.width_sigma_m)}",
                number(lane.vehicles, 0),
                _bar(lane.confidence, number(lane.confidence)),
                number(lane.length_m, 0),
                number(lane.sigma_m),
            )
            for lane in left_to_right(lanes)
        ),
    )


def boundary_table(lanes: Sequence[Lane]) -> str:
    """One row per lane: which lines bound it, and where drivers are between them."""
    return table(
        ("Lane id", "Left boundary", "Right boundary", ">Drivers left of the middle, m"),
        (
            (
                str(lane.lane_id),
                _boundary(lane.left_edge),
                _boundary(lane.right_edge),
                number(lane.driven_offset_m, signed=True),
            )
            for lane in left_to_right(lanes)
        ),
    )


def _boundary(edge: LaneEdge | None) -> str:
    if edge is None or edge.source == "traffic":
        return "by the traffic"
    seen = f", seen on {edge.painted_share:.0%} of its length" if edge.painted_share < 0.995 else ""
    return f"{edge.colour} line, {edge.marking}{seen}, ± {number(edge.sigma_m)} m"


def score_table(score: LaneScore) -> str:
    """One row per true lane: what was found of it."""
    rows = []
    for row in score.lanes:
        found = [str(row.truth_id), number(row.vehicles, 0)]
        if row.lane_id is None:
            found += ["–", '<strong class="bad">missed</strong>', "–", "–", "–", "–", "–"]
        else:
            found += [
                str(row.lane_id),
                str(row.status),
                number(row.mean_m),
                number(row.p95_m),
                number(row.bias_m, signed=True),
                number(row.width_error_m, signed=True),
                f"{row.coverage:.0%}",
            ]
        rows.append(found)
    return table(
        (
            ">True lane",
            ">Vehicles",
            ">Found as",
            "Status",
            ">Mean error, m",
            ">95 % error, m",
            ">Bias to left, m",
            ">Width error, m",
            ">Covered",
        ),
        rows,
    )


def calibration_table(homography: Homography) -> str:
    """One row per control point: where it is and how well it fits."""
    points, residual = homography.points, homography.residual
    worst = max(float(np.max(residual.ground_error_m, initial=0.0)), 1e-9)
    return table(
        (
            ">Line",
            ">Pixel x",
            ">Pixel y",
            ">East, m",
            ">North, m",
            ">Error, px",
            "Error on the road",
        ),
        (
            (
                str(points.line_number[k]),
                f"{points.pixel[k, 0]:.1f}",
                f"{points.pixel[k, 1]:.1f}",
                f"{points.local_m[k, 0]:.2f}",
                f"{points.local_m[k, 1]:.2f}",
                number(float(residual.pixel_error[k])),
                _bar(
                    float(residual.ground_error_m[k]) / worst,
                    f"{number(float(residual.ground_error_m[k]), 3)} m"
                    + ("" if residual.inlier[k] else " · rejected, disagrees with the others"),
                ),
            )
            for k in range(len(points))
        ),
    )


def facts(items: Iterable[tuple[str, str]]) -> str:
    """Names and values, as a definition list."""
    return "<dl>" + "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in items) + "</dl>"


def _direction(heading_deg: float) -> str:
    arrow = (
        f'<svg class="arrow" viewBox="-8 -8 16 16"><path d="M0 6V-6M-4 -2L0 -6L4 -2" '
        f'transform="rotate({heading_deg:.0f})"/></svg>'
    )
    return f"{arrow}{compass(heading_deg)} {heading_deg:.0f}°"


def _bar(share: float, text: str) -> str:
    width = 100 * float(np.clip(np.nan_to_num(share), 0.0, 1.0))
    return f'<span class="bar"><i style="width:{width:.0f}%"></i></span>{escape(text)}'
