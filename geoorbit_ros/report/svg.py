"""Inline SVG as text: coordinates in pixels, colours by CSS class so that a page can be dark."""

from __future__ import annotations

import base64
from html import escape

import numpy as np
from numpy.typing import NDArray


class Canvas:
    """A drawing of `width` by `height` pixels that fills its column.

    Args:
        width: Pixels.
        height: Pixels.
        title: What the drawing shows, for screen readers.
        description: More about it, for screen readers.
    """

    def __init__(self, width: float, height: float, title: str, description: str = "") -> None:
        self.width, self.height, self.title = width, height, title
        self.description = description
        self._parts: list[str] = []

    def raw(self, markup: str) -> None:
        """Add SVG markup as it is."""
        self._parts.append(markup)

    def line(self, points: NDArray[np.float64], css: str, tip: str = "") -> None:
        """A polyline through (K, 2) pixels; NaN interrupts it."""
        data = path_data(points)
        if data:
            self._parts.append(_shape("path", f'd="{data}"', css, tip))

    def area(self, points: NDArray[np.float64], css: str, tip: str = "") -> None:
        """A closed polygon through (K, 2) pixels; points that are NaN are left out."""
        points = points[np.isfinite(points).all(axis=1)]
        if len(points) > 2:
            self._parts.append(_shape("path", f'd="{path_data(points)}Z"', css, tip))

    def image(self, jpeg: bytes) -> None:
        """A JPEG file that fills the drawing."""
        data = base64.b64encode(jpeg).decode("ascii")
        self._parts.append(
            f'<image width="{self.width:.1f}" height="{self.height:.1f}" '
            f'preserveAspectRatio="none" href="data:image/jpeg;base64,{data}"/>'
        )

    def text(self, x: float, y: float, text: str, css: str = "", anchor: str = "start") -> None:
        """Text with its baseline at `y`; anchor start, middle or end."""
        self._parts.append(
            f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" class="{css}">'
            f"{escape(text)}</text>"
        )

    def badge(self, at: NDArray[np.float64], text: str, css: str, tip: str = "") -> None:
        """A small filled circle at pixel (2,) with a number in it."""
        x, y = at
        radius = 6.0 + 2.5 * len(text)
        title = f"<title>{escape(tip)}</title>" if tip else ""
        self._parts.append(
            f'<g class="badge {css}"><circle cx="{x:.1f}" cy="{y:.1f}" r="{radius}"/>'
            f'<text x="{x:.1f}" y="{y + 3.8:.1f}" text-anchor="middle">{escape(text)}</text>'
            f"{title}</g>"
        )

    def chevron(self, at: NDArray[np.float64], direction: NDArray[np.float64], css: str) -> None:
        """A travel arrow at pixel (2,) pointing along `direction` (2,)."""
        along = direction / max(float(np.hypot(*direction)), 1e-9)
        across = np.array([-along[1], along[0]])
        back = at - 4.0 * along
        corners = np.stack((back + 3.2 * across, at + 3.0 * along, back - 3.2 * across))
        self.line(corners, f"chevron {css}")

    def open_clip(self, name: str, x: float, y: float, width: float, height: float) -> None:
        """Start a group that is cut at a rectangle; end it with `close`."""
        self._parts.append(
            f'<clipPath id="{name}"><rect x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" '
            f'height="{height:.1f}"/></clipPath><g clip-path="url(#{name})">'
        )

    def close(self) -> None:
        """End the group opened last."""
        self._parts.append("</g>")

    def markup(self) -> str:
        """The whole drawing."""
        more = f"<desc>{escape(self.description)}</desc>" if self.description else ""
        return (
            f'<svg viewBox="0 0 {self.width:.0f} {self.height:.0f}" role="img">'
            f"<title>{escape(self.title)}</title>{more}{''.join(self._parts)}</svg>"
        )


def path_data(points: NDArray[np.float64]) -> str:
    """SVG path commands through (K, 2) pixels, tenths of a pixel, broken at NaN."""
    finite: NDArray[np.bool_] = np.asarray(np.isfinite(points).all(axis=1))
    runs = np.split(np.arange(len(points)), np.flatnonzero(np.diff(finite.astype(int))) + 1)
    data = []
    for run in runs:
        if len(run) > 1 and finite[run[0]]:
            tenths = np.clip(points[run], -1e5, 1e5).round(1)
            data.append("M" + " ".join(f"{x:.1f} {y:.1f}" for x, y in tenths))
    return "".join(data)


def nice_step(span: float, parts: int = 6) -> float:
    """A round step (1, 2 or 5 times a power of ten) that cuts `span` into about `parts`."""
    raw = span / max(parts, 1)
    power = 10.0 ** np.floor(np.log10(raw))
    return float(power * min((1, 2, 5, 10), key=lambda m: abs(m * power - raw)))


def _shape(name: str, attributes: str, css: str, tip: str) -> str:
    if tip:
        return f'<{name} {attributes} class="{css}"><title>{escape(tip)}</title></{name}>'
    return f'<{name} {attributes} class="{css}"/>'
