"""What learning brings: losses of trained models as shares of those of the fixed parameters.

A population is trained from scratch into a folder that is thrown away, unless `--out` names one
with cameras already in it. Without options it is the small study, which takes a few minutes; the
figures of the guide are those of `params/studies/roads.yaml` with five seeds.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np

from geoorbit_ros.cli.console import shown_progress
from geoorbit_ros.learning.evaluation import BASELINE, FEDMETA, META, ModelResult, evaluate
from geoorbit_ros.learning.study import open_study, train_study
from geoorbit_ros.learning.training import MODES, RunSettings
from geoorbit_ros.metrics.paper_losses import TERMS

STUDIES = Path(__file__).parents[1] / "params" / "studies"
HALF = 0.5
"""With geolane FedMeta's total on unseen cameras is at most this share of the baseline's."""
NEAR_CENTRAL = 1.05
COUNT_WRONG = 0.03
"""Share of unseen cameras on which curvilinear may find another number of lanes."""


def report(name: str, ratio: float, limit: float | None = None) -> None:
    """Print one line for the runner."""
    line = {"name": name, "ratio": round(ratio, 4)}
    print(json.dumps(line if limit is None else {**line, "limit": limit}), flush=True)


def mean(rows: list[ModelResult], model: str, term: str = "total") -> float:
    """Mean over unseen cameras and seeds."""
    chosen = [row for row in rows if row.model == model and row.split == "unseen"]
    return float(np.mean([row.mean(term) for row in chosen]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--study", type=Path, default=STUDIES / "small.yaml")
    parser.add_argument("--out", type=Path, help="keep cameras, models and tables here")
    parser.add_argument("--seeds", type=int, default=1, help="one per draw of cameras")
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--workers", type=int, default=2)
    chosen = parser.parse_args()
    rows: dict[str, list[ModelResult]] = {}
    with tempfile.TemporaryDirectory() as scratch:
        study = open_study(chosen.out or Path(scratch) / "study", chosen.study, chosen.workers)
        settings = RunSettings(rounds=chosen.rounds)
        for estimator in ("geolane", "curvilinear"):
            with shown_progress() as progress:
                train_study(study, estimator, MODES, range(chosen.seeds), settings, progress)
                rows[estimator] = evaluate(study, estimator, progress)
    full = chosen.study.stem == "roads"  # the promises are about this study
    geolane, ours = rows["geolane"], rows["curvilinear"]
    fed = mean(geolane, FEDMETA)
    report("geolane, unseen: FedMeta / baseline", fed / mean(geolane, BASELINE), HALF)
    limit = NEAR_CENTRAL if full else None
    report("geolane, unseen: FedMeta / Meta", fed / mean(geolane, META), limit)
    for model in (META, FEDMETA):
        ratio = mean(ours, model) / mean(ours, BASELINE)
        report(f"curvilinear, unseen: {model} / baseline", ratio, 1.0)
    worst = max(
        mean(ours, model, term) / max(mean(geolane, model, term), 1e-9)
        for model in (BASELINE, META, FEDMETA)
        for term in TERMS
    )
    report("curvilinear / geolane, unseen: the worst loss", worst, 1.0)
    results = [
        result
        for row in ours
        if (row.model, row.split) == (FEDMETA, "unseen")
        for result in row.cameras.values()
    ]
    limit = COUNT_WRONG if full else None
    wrong = float(np.mean([not result.count_right for result in results]))
    report("curvilinear, unseen: share of cameras with a wrong lane count", wrong, limit)
    wrong = float(np.mean([result.losses.lane_num != 0.0 for result in results]))
    report("the same with tentative lanes counted", wrong, limit)


if __name__ == "__main__":
    main()
