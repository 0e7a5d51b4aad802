"""A study: a fleet's cameras, models trained on the seen ones, and all models judged on all."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.learning.history import Round, save_history
from geoorbit_ros.learning.local_training import Examples
from geoorbit_ros.learning.loss_table import LossTable
from geoorbit_ros.learning.meta_learner import MetaLearner
from geoorbit_ros.learning.model_file import save_model
from geoorbit_ros.learning.parameter_space import DEFAULT_UNIT
from geoorbit_ros.learning.population import Fleet, load_fleet
from geoorbit_ros.learning.population_cameras import (
    FleetCamera,
    best_parameters,
    examples_of,
    fleet_cameras,
    teachers_and_judges,
)
from geoorbit_ros.learning.processes import Progress, quiet
from geoorbit_ros.learning.training import MODES, Mode, RunSettings, TrainedModel, train
from geoorbit_ros.learning.validation import Jury, gains_of, roles
from geoorbit_ros.storage.atomic import atomic_output

CAMERAS, FLEET_FILE = "cameras", "fleet.yaml"


@dataclass(frozen=True, slots=True)
class Study:
    """A folder that `geoorbit train` fills and `geoorbit evaluate` reads.

    Attributes:
        folder: It holds `fleet.yaml`, `cameras/` and one folder per estimator with a model
            `<mode>-<seed>.npz`, its history `.csv` and its settings `.json`.
        fleet: The fleet.
        workers: Processes.
    """

    folder: Path
    fleet: Fleet
    workers: int = 1

    def model_path(self, estimator: str, mode: Mode, seed: int) -> Path:
        """Where a trained model is."""
        return self.folder / estimator / f"{mode}-{seed}.npz"

    def models(self, estimator: str, mode: Mode) -> list[Path]:
        """The trained models of an estimator and mode, one per seed."""
        found = (self.folder / estimator).glob(f"{mode}-*.npz")
        return sorted(found, key=seed_of)

    def cameras(self, seed: int = 0, progress: Progress = quiet) -> list[FleetCamera]:
        """The cameras that training with this seed is about, made where they are not there yet."""
        fleet = self.fleet.of_draw(seed)
        return fleet_cameras(fleet, self.folder / CAMERAS, self.workers, progress)

    def trained_seeds(self, estimator: str) -> list[int]:
        """Seeds of all trained models of an estimator, ascending."""
        paths = [path for mode in MODES for path in self.models(estimator, mode)]
        return sorted({seed_of(path) for path in paths})


def seed_of(path: Path) -> int:
    """The seed in the name of a model."""
    return int(path.stem.rpartition("-")[2])


def open_study(folder: Path, fleet_file: Path | None = None, workers: int = 1) -> Study:
    """The study in a folder; with `fleet_file`, one for that fleet, begun if need be.

    Raises:
        InputFileError: No study there, or one of another fleet.
    """
    kept = folder / FLEET_FILE
    if fleet_file is None:
        if not kept.exists():
            raise InputFileError(str(folder), "no fleet.yaml", "a folder of geoorbit train")
        return Study(folder, load_fleet(kept), workers)
    fleet = load_fleet(fleet_file)
    if kept.exists() and load_fleet(kept) != fleet:
        raise InputFileError(str(folder), "a study of another fleet", "a new folder")
    if not kept.exists():
        with atomic_output(kept) as path:
            path.write_bytes(fleet_file.read_bytes())
    return Study(folder, fleet, workers)


def train_study(
    study: Study,
    estimator: str,
    modes: Sequence[Mode],
    seeds: Sequence[int],
    settings: RunSettings,
    progress: Progress = quiet,
) -> dict[tuple[Mode, int], TrainedModel]:
    """Train one model per mode and seed, and write each; a rejected one becomes the defaults.

    A model is accepted only if the judges among the seen cameras, from which it has learned
    nothing, find it better than the default parameters (`federated.rounds.verdict`).

    Raises:
        InputFileError: No seen camera on which a lane can be found.
    """
    models: dict[tuple[Mode, int], TrainedModel] = {}
    for draw in range(min(study.fleet.draws, len(seeds))):
        drawn = [seed for seed in seeds if seed % study.fleet.draws == draw]
        models |= _train_draw(study, estimator, modes, drawn, settings, progress)
    return models


def _train_draw(
    study: Study,
    estimator: str,
    modes: Sequence[Mode],
    seeds: Sequence[int],
    settings: RunSettings,
    progress: Progress,
) -> dict[tuple[Mode, int], TrainedModel]:
    """The models of seeds that share their cameras."""
    cameras = study.cameras(seeds[0], progress)
    teachers, judges = teachers_and_judges(cameras)
    best = best_parameters(
        teachers, estimator, study.folder / CAMERAS, study.workers, progress=progress
    )
    examples = examples_of(teachers, best)
    if not examples:
        raise InputFileError(str(study.folder), "no seen camera with a lane", "more traffic")
    table = LossTable(
        {camera.camera_id: camera.path for camera in [*teachers, *judges]},
        estimator,
        "supervision",
        study.workers,
    )

    def composite(learner: MetaLearner, names: Sequence[str]) -> NDArray[np.float64]:
        asked = [(name, learner.predict_unit(examples[name].features[0])) for name in names]
        return np.array([losses.total for losses in table.losses(asked)])

    jury = jury_of(cameras, examples, table)
    models: dict[tuple[Mode, int], TrainedModel] = {}
    for mode in modes:
        for seed in seeds:
            chosen = replace(settings, seed=seed)
            what = f"training {mode} {seed} ({estimator})"
            progress(what, 0.0)

            def show(entry: Round, what: str = what) -> None:
                progress(what, entry.number / (settings.rounds + 1))

            model = train(mode, examples, composite, chosen, show, jury)
            if not model.verdict.accepted:
                model = replace(model, learner=MetaLearner.untrained(seed))
            models[mode, seed] = model
            _write_model(study.model_path(estimator, mode, seed), model, chosen)
    return models


def jury_of(
    cameras: Sequence[FleetCamera], examples: dict[str, Examples], table: LossTable
) -> Jury:
    """The judges of a study; where everybody judges, those who also teach."""
    seen = [camera for camera in cameras if camera.split == "seen"]
    divisor, _, names = roles([camera.camera_id for camera in seen])
    judges = [
        camera
        for camera in seen
        if camera.camera_id in names and (divisor > 1 or camera.camera_id in examples)
    ]

    def gains(learner: MetaLearner) -> list[float]:
        asked = [(camera.camera_id, learner.predict_unit(camera.features)) for camera in judges]
        fixed = [(camera.camera_id, DEFAULT_UNIT) for camera in judges]
        losses = table.losses([*asked, *fixed])
        return gains_of(losses[: len(judges)], losses[len(judges) :])

    return Jury(tuple(camera.camera_id for camera in judges), divisor, gains)


def _write_model(path: Path, model: TrainedModel, settings: RunSettings) -> None:
    save_model(model.learner, path)
    save_history(model.rounds, path.with_suffix(".csv"))
    about = {
        "settings": asdict(settings),
        "traffic": asdict(model.traffic),
        "verdict": asdict(model.verdict),
    }
    with atomic_output(path.with_suffix(".json")) as temporary:
        temporary.write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")
