"""OpenStreetMap extracts for tests, and what a camera sees of their traffic."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.scenes.camera import look_at

ENGLAND, BAVARIA = Datum(51.6, -1.2), Datum(48.2, 11.5)
Points = Sequence[tuple[float, float]]


class MadeExtract:
    """An extract, element by element; points are metres east and north of a datum.

    Args:
        datum: Where it lies.
    """

    def __init__(self, datum: Datum = BAVARIA) -> None:
        self.datum = datum
        self._nodes: dict[tuple[float, float], int] = {}
        self._texts: list[str] = []
        self._extra: dict[tuple[float, float], tuple[str, Mapping[str, str]]] = {}

    def node(self, point: tuple[float, float], attributes: str = "", **tags: str) -> int:
        """The id of the node at a point; attributes and tags are added to it."""
        if attributes or tags:
            self._extra[point] = (attributes, tags)
        return self._nodes.setdefault(point, len(self._nodes) + 1)

    def way(
        self, number: int, points: Points, tags: Mapping[str, str], attributes: str = ""
    ) -> None:
        """Add a way."""
        refs = "".join(f'<nd ref="{self.node(point)}"/>' for point in points)
        self._texts.append(f'<way id="{number}" version="1" {attributes}>{refs}{_tags(tags)}</way>')

    def text(self, root: str = '<osm version="0.6">') -> str:
        """The file's text."""
        places = self.datum.to_geodetic(list(self._nodes) or [(0.0, 0.0)])[: len(self._nodes)]
        nodes = "".join(
            f'<node id="{number}" version="1" lat="{lat:.8f}" lon="{lon:.8f}" '
            f"{self._extra.get(point, ('', {}))[0]}>{_tags(self._extra.get(point, ('', {}))[1])}"
            "</node>"
            for (point, number), (lat, lon) in zip(self._nodes.items(), places, strict=True)
        )
        return f'<?xml version="1.0" encoding="UTF-8"?>{root}{nodes}{"".join(self._texts)}</osm>'

    def write(self, path: Path) -> Path:
        """Write the file; its path."""
        path.write_text(self.text(), encoding="utf-8")
        return path


def road(datum: Datum, tags: Mapping[str, str], half_m: float = 150.0) -> MadeExtract:
    """A straight road from south to north through the datum, with these tags: way 10."""
    extract = MadeExtract(datum)
    extract.way(10, [(0.0, -half_m), (0.0, half_m)], {"highway": "primary", **tags})
    return extract


def _tags(tags: Mapping[str, str]) -> str:
    return "".join(f"<tag k={quoteattr(k)} v={quoteattr(v)}/>" for k, v in tags.items())


class MadeCamera:
    """A camera on a pole beside a road to the north, and the traffic that it sees.

    Args:
        datum: Its map frame; the pole stands 150 m south of it.
    """

    def __init__(self, datum: Datum) -> None:
        self.datum = datum
        self._camera = look_at(
            np.array([-2.0, -150.0, 14.0]), np.array([0.0, -40.0, 0.0]), 60.0, (1920, 1080)
        )
        self._rows: list[tuple[float, int, int, float, float]] = []
        self._tracks = 0

    def drive(
        self,
        line: NDArray[np.float64],
        vehicles: int,
        speed_mps: float = 15.0,
        begin_s: float = 0.0,
        every_s: float = 4.0,
        coco_class: int = 2,
    ) -> None:
        """Vehicles one after another along a line (K, 2) of the map frame, ten times a second."""
        step = np.hypot(*np.diff(line, axis=0).T)
        arc = np.append(0.0, np.cumsum(step))
        for number in range(vehicles):
            self._tracks += 1
            times = np.arange(0.0, arc[-1] / speed_mps, 0.1)
            xy = np.column_stack([np.interp(times * speed_mps, arc, line[:, k]) for k in range(2)])
            pixel, depth = self._camera.project(np.column_stack((xy, np.zeros(len(xy)))))
            seen = (depth > 0) & (pixel >= 0).all(axis=1) & (pixel < (1920, 1080)).all(axis=1)
            start = round((begin_s + number * every_s) * 10)
            for k in np.flatnonzero(seen).tolist():
                self._rows.append((*pixel[k].tolist(), start + k, self._tracks, coco_class))

    @property
    def tracks(self) -> int:
        """How many vehicles there were."""
        return self._tracks

    def write(self, folder: Path) -> tuple[Path, Path]:
        """Write tracks.csv, of points on the ground, and calibration.csv; their paths."""
        tracks, calibration = folder / "tracks.csv", folder / "calibration.csv"
        rows = sorted(self._rows, key=lambda row: (row[2], row[3]))
        tracks.write_text(
            "id,time,frame_num,class,conf,x,y,w,h\n"
            + "".join(
                f"{track},{frame / 10:.1f},{frame},{kind},0.9,{x:.2f},{y:.2f},0,0\n"
                for x, y, frame, track, kind in rows
            )
        )
        ground = np.array([(x, y) for x in (-8.0, 0.0, 9.0) for y in (-100.0, -60.0, 0.0, 80.0)])
        pixel, _ = self._camera.project(np.column_stack((ground, np.zeros(len(ground)))))
        places = self.datum.to_geodetic(ground)
        calibration.write_text(
            "pixel_x,pixel_y,latitude,longitude\n"
            + "".join(
                f"{u:.2f},{v:.2f},{lat:.9f},{lon:.9f}\n"
                for (u, v), (lat, lon) in zip(pixel, places, strict=True)
            )
        )
        return tracks, calibration
