"""The tables of a study as Markdown and CSV, and its loss figures."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib.figure
import numpy as np

from geoorbit_ros.federated.rounds.traffic import Traffic, bits_per_second
from geoorbit_ros.learning.camera_task import load_task
from geoorbit_ros.learning.evaluation import BASELINE, FEDMETA, META, CameraResult, ModelResult
from geoorbit_ros.learning.meta_learner import MetaLearner, load_model
from geoorbit_ros.learning.population_cameras import split_seen_cameras
from geoorbit_ros.learning.study import Study
from geoorbit_ros.learning.training import MODES, Mode, Round, load_history
from geoorbit_ros.metrics.lane_score import Tally
from geoorbit_ros.metrics.paper_losses import TERMS


@dataclass(frozen=True, slots=True)
class Table:
    """Cells as text.

    Attributes:
        title: Above the table.
        header: Names of the columns.
        rows: One list of cells per row.
    """

    title: str
    header: tuple[str, ...]
    rows: list[list[str]]

    def markdown(self) -> str:
        """As a Markdown table under its title."""
        left = 2
        rule = ["---" if k < left else "--:" for k in range(len(self.header))]
        lines = [list(self.header), rule, *self.rows]
        body = "\n".join(f"| {' | '.join(line)} |" for line in lines)
        return f"**{self.title}**\n\n{body}\n"

    def csv(self) -> str:
        """As comma-separated values."""
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([list(self.header), *self.rows])
        return text.getvalue()


def loss_table(rows: Sequence[ModelResult], estimator: str) -> Table:
    """The paper's table of validation losses: mean over cameras, ± spread over seeds."""
    header = ("cameras", "model", *TERMS, "median total", "total against baseline")
    body = []
    for split, model, group in _groups(rows):
        fixed = [r for r in rows if (r.model, r.split) == (BASELINE, split)]
        ratio = [_total(r) / _total(_of_same_cameras(fixed, r), r) - 1.0 for r in group]
        cells = [_spread([r.mean(term) for r in group]) for term in TERMS]
        median = _spread([r.median_total() for r in group])
        body.append([split, model, *cells, median, _percent(ratio)])
    fixed = [row for row in rows if row.model == BASELINE]
    count = {row.split: len(row.cameras) for row in fixed}
    cameras = ", ".join(f"{n} {split}" for split, n in count.items())
    seeds = max(len(group) for _, _, group in _groups(rows))
    draws = len(fixed) // max(len(count), 1)
    title = (
        f"Losses, {estimator}: mean over cameras ({cameras} in each of {draws} draws) ± spread "
        f"over {seeds} seeds"
    )
    return Table(title, header, body)


def error_table(rows: Sequence[ModelResult], estimator: str) -> Table:
    """Honest errors on cameras whose true lanes are known, all seeds together."""
    header = (
        "cameras",
        "model",
        "no lane found %",
        "lane count right %",
        "with tentative %",
        "all found, none invented %",
        "8+ veh. confirmed %",
        "3–7 veh. found %",
        "invented per camera",
        "wrong way per camera",
        "centre mean m",
        "95 % m",
        "width m",
        "seen %",
    )
    body = []
    for split, model, group in _groups(rows):
        tally = Tally()
        results = [r for row in group for r in row.cameras.values() if r.score is not None]
        for result in results:
            if result.score is not None:
                tally.add(result.score)
        cameras = max(len(results), 1)
        body.append(
            [
                split,
                model,
                _number(100.0 * float(np.mean([r.losses.detected == 0 for r in results])), 1),
                _number(100.0 * float(np.mean([r.count_right for r in results])), 1),
                _number(100.0 * float(np.mean([r.losses.lane_num == 0.0 for r in results])), 1),
                _number(100.0 * float(np.mean([_passed(r) for r in results])), 1),
                _number(100.0 * tally.busy_confirmed / max(tally.busy, 1), 1),
                _number(100.0 * tally.sparse_found / max(tally.sparse, 1), 1),
                _number(tally.invented / cameras, 3),
                _number(tally.wrong_way / cameras, 3),
                *(_number(value, 3) for value in tally.errors_m()),
                _number(100.0 * tally.coverage, 0),
            ]
        )
    return Table(f"Errors against the true lanes, {estimator}", header, body)


def recording_table(rows: Sequence[ModelResult], estimator: str) -> Table:
    """Each real camera by itself, against the road network."""
    header = ("camera", "model", *TERMS, "lanes found")
    body = []
    for split, model, group in _groups(rows):
        for name in [n for n, r in group[0].cameras.items() if r.score is None]:
            results = [row.cameras[name] for row in group]
            cells = [_spread([getattr(r.losses, term) for r in results]) for term in TERMS]
            lanes = _spread([float(r.losses.detected) for r in results], 0)
            body.append([f"{name} ({split})", model, *cells, lanes])
    return Table(f"Real cameras against the road network, {estimator}", header, body)


def communication_table(study: Study, estimator: str) -> Table:
    """The paper's table of communication: what has to leave the cameras."""
    training, _ = split_seen_cameras(study.cameras())
    tracks = sum(load_task(camera.path).tracks.rows.nbytes for camera in training)
    header = ("", "Baseline", META, FEDMETA)
    federated = study.models(estimator, "federated")
    if not federated:
        return Table(f"Communication, {estimator}: no federated model", header, [])
    about = json.loads(federated[0].with_suffix(".json").read_text(encoding="utf-8"))
    traffic, rounds = Traffic(**about["traffic"]), int(about["settings"]["rounds"])
    size = _model_bytes(load_model(federated[0]))
    duration = rounds * study.population.duration_s
    bps = bits_per_second(traffic.total_bytes, duration)
    track_bps = bits_per_second(tracks, study.population.duration_s)
    kilo = [f"{value / 1e3:,.1f}" for value in (size, traffic.up_bytes, traffic.down_bytes, tracks)]
    body = [
        ["model, kB", "0", "0", kilo[0]],
        ["clients", *[str(len(training))] * 2, str(traffic.up_messages // rounds)],
        ["rounds", "1", "1", str(rounds)],
        ["encoding", "–", "–", str(about["settings"]["encoding"])],
        ["updates up, kB", "0", "0", kilo[1]],
        ["tracks up, kB", kilo[3], kilo[3], "0"],
        ["models down, kB", "0", "0", kilo[2]],
        ["BPS, kbit/s", *[f"{track_bps / 1e3:,.2f}"] * 2, f"{bps / 1e3:,.2f}"],
    ]
    title = (
        f"Communication, {estimator}: ground tracks instead of video; one round per "
        f"observation of {study.population.duration_s:g} s"
    )
    return Table(title, header, body)


def write_tables(tables: dict[str, Table], folder: Path) -> None:
    """One CSV file per table and all of them in `tables.md`."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, table in tables.items():
        (folder / f"{name}.csv").write_text(table.csv(), encoding="utf-8")
    text = "\n".join(table.markdown() for table in tables.values() if table.rows)
    (folder / "tables.md").write_text(text, encoding="utf-8")


def _groups(rows: Sequence[ModelResult]) -> list[tuple[str, str, list[ModelResult]]]:
    """Rows of one split and model together, over seeds; seen first."""
    keys = dict.fromkeys((row.split, row.model) for row in rows)
    ordered = sorted(keys, key=lambda key: key[0] != "seen")
    return [
        (split, model, [r for r in rows if (r.split, r.model) == (split, model)])
        for split, model in ordered
        if any(r.cameras for r in rows if (r.split, r.model) == (split, model))
    ]


def _of_same_cameras(fixed: Sequence[ModelResult], row: ModelResult) -> ModelResult:
    return next(f for f in fixed if set(row.cameras) <= set(f.cameras))


def _passed(result: CameraResult) -> bool:
    return result.score is not None and result.score.passed


def _total(row: ModelResult, like: ModelResult | None = None) -> float:
    """Mean L_total, over the cameras of another row where that has fewer."""
    names = (like or row).cameras
    return float(np.mean([row.cameras[name].losses.total for name in names]))


def _model_bytes(learner: MetaLearner) -> int:
    return sum(value.nbytes for value in learner.weights.values())


def _spread(values: Sequence[float], decimals: int | None = None) -> str:
    mean = float(np.mean(values))
    digits = decimals if decimals is not None else 0 if mean >= 1000 else 1 if mean >= 100 else 2
    if len(values) == 1:
        return f"{mean:.{digits}f}"
    return f"{mean:.{digits}f} ± {np.std(values):.{digits}f}"


def _percent(values: Sequence[float]) -> str:
    text = f"{100.0 * np.mean(values):+.1f}"
    return f"{text} %" if len(values) == 1 else f"{text} ± {100.0 * np.std(values):.1f} %"


def _number(value: float, decimals: int) -> str:
    return f"{value:.{decimals}f}" if np.isfinite(value) else "–"


TITLES: dict[Mode, str] = {"central": "Meta-GeoLane", "federated": "FedMeta-GeoLane"}
COLOURS: dict[Mode, str] = {"central": "#b45f06", "federated": "#1f5a99"}


def draw_losses(study: Study, estimator: str, folder: Path) -> list[Path]:
    """Parameter alignment loss over rounds, mean and spread over cameras, one figure per mode.

    Lines are the mean over cameras, one per seed; the band is one standard deviation over cameras
    around the mean of all seeds.
    """
    written = []
    for mode in MODES:
        histories = [
            load_history(path.with_suffix(".csv")) for path in study.models(estimator, mode)
        ]
        if histories:
            folder.mkdir(parents=True, exist_ok=True)
            written.append(folder / f"loss-{mode}-{estimator}.png")
            _draw(histories, mode, estimator, written[-1])
    return written


def _draw(histories: Sequence[Sequence[Round]], mode: Mode, estimator: str, path: Path) -> None:
    figure = matplotlib.figure.Figure(figsize=(5.0, 3.2), layout="constrained")
    axes = figure.subplots()
    shortest = min(len(history) for history in histories)
    number = np.arange(shortest)
    loss = np.array([[r.parameter_loss for r in h[:shortest]] for h in histories])
    spread = np.array([[r.parameter_loss_std for r in h[:shortest]] for h in histories])
    for line in loss:
        axes.plot(number, line, color=COLOURS[mode], linewidth=0.8, alpha=0.6)
    middle, width = loss.mean(axis=0), spread.mean(axis=0)
    band = (np.maximum(middle - width, 0.0), middle + width)
    axes.fill_between(number, *band, color=COLOURS[mode], alpha=0.15, linewidth=0.0)
    axes.set_xlabel("rounds")
    axes.set_ylabel("parameter alignment loss")
    axes.set_title(f"{TITLES[mode]} ({estimator})", fontsize=10)
    axes.set_ylim(bottom=0.0)
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=150)
