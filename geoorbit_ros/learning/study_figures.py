"""The two loss figures of a study."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib.figure
import numpy as np

from geoorbit_ros.learning.history import Round, load_history
from geoorbit_ros.learning.study import Study
from geoorbit_ros.learning.training import MODES, Mode

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
