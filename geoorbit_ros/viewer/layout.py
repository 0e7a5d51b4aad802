"""Layouts for Foxglove-compatible viewers: one column per camera, diagnostics below."""

from __future__ import annotations

from collections.abc import Sequence

MAX_COLUMNS = 3
"""Cameras with a column. Chosen: more can't be read side by side; the others can be chosen in the
panels."""

IMAGE, ANNOTATIONS, LANE_MAP = "image/compressed", "image/annotations", "lanes/map"
SCENE_TOPICS = ("lanes/markers", "lanes", "vehicles", "tracks")
DIAGNOSTICS, TWIN = "/diagnostics", "/twin/vehicles"


def layout_topics(cameras: Sequence[str]) -> set[str]:
    """All topics that a layout of these cameras shows."""
    shown = {DIAGNOSTICS, TWIN}
    for camera in cameras[:MAX_COLUMNS]:
        shown |= {f"/{camera}/{t}" for t in (IMAGE, ANNOTATIONS, LANE_MAP, "datum", *SCENE_TOPICS)}
    return shown


def make_layout(cameras: Sequence[str]) -> dict[str, object]:
    """A layout file's content: image with boxes, lanes and vehicles in 3D, map, diagnostics.

    Args:
        cameras: Camera ids; the first `MAX_COLUMNS` get a column.
    """
    panels: dict[str, object] = {
        "DiagnosticSummary!health": {"topicToRender": DIAGNOSTICS, "minLevel": 0},
    }
    columns: list[object] = []
    for camera in cameras[:MAX_COLUMNS]:
        panels[f"Image!{camera}"] = {
            "imageMode": {
                "imageTopic": f"/{camera}/{IMAGE}",
                "annotations": {f"/{camera}/{ANNOTATIONS}": {"visible": True}},
            }
        }
        panels[f"3D!{camera}"] = {
            "followTf": "map",
            "followMode": "follow-none",
            "cameraState": {"perspective": False, "distance": 150, "phi": 0, "thetaOffset": 0},
            "topics": {f"/{camera}/{topic}": {"visible": True} for topic in SCENE_TOPICS}
            | {TWIN: {"visible": True}},
        }
        panels[f"map!{camera}"] = {
            "zoomLevel": 17,
            "followTopic": f"/{camera}/datum",
            "topicColors": {f"/{camera}/{LANE_MAP}": "#29b6f6"},
        }
        views = [f"Image!{camera}", f"3D!{camera}", f"map!{camera}"]
        columns.append(_split("column", views))
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _split("column", [_split("row", columns), "DiagnosticSummary!health"], 80),
    }


def _split(direction: str, parts: Sequence[object], first_percent: float | None = None) -> object:
    """Panels beside or below each other, as the nested halves that the format knows."""
    if len(parts) == 1:
        return parts[0]
    percent = first_percent or 100.0 / len(parts)
    rest = _split(direction, parts[1:])
    return {
        "direction": direction,
        "first": parts[0],
        "second": rest,
        "splitPercentage": percent,
    }
