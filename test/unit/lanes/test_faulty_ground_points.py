"""A scene as ground points, a tenth of its rows faulty, has the same lanes as without a fault."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made_scenes import run_of

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.core.lanes import LaneMap
from geoorbit_ros.core.tables import Frames
from geoorbit_ros.lanes.estimators.estimator import make_estimator
from geoorbit_ros.lanes.mapping.mapper import LaneMapper
from geoorbit_ros.lanes.pipeline import map_lanes, project_frames
from geoorbit_ros.metrics.lane_score import LaneScore
from geoorbit_ros.metrics.score import score_lanes
from geoorbit_ros.scenes.output import clean_pixels
from geoorbit_ros.scenes.scene import shipped_scenes
from geoorbit_ros.scenes.simulate import SceneRun
from geoorbit_ros.storage.track_csv import write_track_csv
from geoorbit_ros.storage.tracks.cleaning import ReadOptions
from geoorbit_ros.storage.tracks.reader import read_tracks

SHARE = 0.1


def faulty(lines: list[str], random: np.random.Generator) -> list[str]:
    """A tenth of the rows: some twice, some without a number, some moved within a second."""
    header, *rows = lines
    at = random.permutation(len(rows))[: round(SHARE * len(rows))]
    kind = random.integers(0, 3, len(at))
    for k in at[kind == 0]:
        cells = rows[k].split(",")
        cells[5] = "nan"
        rows[k] = ",".join(cells)
    place = np.arange(len(rows), dtype=np.float64)
    place[at[kind == 1]] += random.integers(-300, 300, np.count_nonzero(kind == 1))
    again = [rows[k] for k in at[kind == 2]]
    return [header, *(rows[k] for k in np.argsort(place, kind="stable")), *again]


def lanes(run: SceneRun, frames: Frames, image_size: tuple[int, int]) -> LaneMap:
    projector = BoxProjector(fit_homography(run.control_points), image_size)
    lane_map = map_lanes(
        project_frames(frames, projector), LaneMapper(make_estimator("curvilinear"))
    )
    assert not projector.doubtful
    return lane_map


def against(found: LaneMap, reference: LaneMap) -> LaneScore:
    return score_lanes(found.lanes, reference.lanes)


@pytest.mark.parametrize("scene", shipped_scenes())
def test_faulty_rows_move_no_lane_by_five_centimetres(scene: str, tmp_path: Path) -> None:
    run = run_of(scene, duration_s=30.0)
    clean = clean_pixels(run)
    file = tmp_path / "clean.csv"
    write_track_csv(file, clean)
    reference = lanes(run, clean, run.image_size)
    lines = file.read_text(encoding="utf-8").splitlines()
    bad = tmp_path / "faulty.csv"
    bad.write_text("\n".join(faulty(lines, np.random.default_rng(3))), encoding="utf-8")
    # A tenth of the points lies below the image, as at cameras whose image was cropped.
    height = int(np.quantile(clean.rows["y"], 1.0 - SHARE))
    frames, report = read_tracks(bad, ReadOptions((run.image_size[0], height)))
    said = " ".join(report.sentences())
    for words in ("outside the image", "no number", "sorted", "an id twice"):
        assert words in said
    score = against(lanes(run, frames, (run.image_size[0], height)), reference)
    assert not score.missed("busy")
    assert not score.invented
    assert not score.unconfirmed
    assert score.centerline_mean_m <= 0.05
