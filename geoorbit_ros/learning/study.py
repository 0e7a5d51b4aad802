"""A study: the cameras of a population, models trained on some, all models measured on all."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.plugins import is_plugin, plugin_file, registered, short_name
from geoorbit_ros.learning.local_training import Examples
from geoorbit_ros.learning.loss_table import LossTable
from geoorbit_ros.learning.meta_learner import MetaLearner, save_model
from geoorbit_ros.learning.parameter_space import DEFAULT_UNIT
from geoorbit_ros.learning.population import Population, load_population
from geoorbit_ros.learning.population_cameras import (
    PopulationCamera,
    best_parameters,
    examples_of,
    population_cameras,
    split_seen_cameras,
)
from geoorbit_ros.learning.processes import Progress, quiet
from geoorbit_ros.learning.training import (
    MODES,
    Mode,
    Round,
    RunSettings,
    TrainedModel,
    save_history,
    train,
)
from geoorbit_ros.learning.validation import ValidationCameras, gains_of, roles
from geoorbit_ros.storage.atomic import atomic_output

CAMERAS, POPULATION_FILE = "cameras", "population.yaml"
"""Names in a study's folder."""
PLUGIN_FILE = "plugin.txt"
"""In a plug-in's folder, which has the name of its class: `FILE.py:CLASS`."""
OLD_POPULATION_FILE = "fleet.yaml"
"""The name in folders that were made before 0.1.0."""


@dataclass(frozen=True, slots=True)
class Study:
    """A folder that `geoorbit train` fills and `geoorbit evaluate` reads.

    Attributes:
        folder: It holds `population.yaml`, `cameras/` and one folder per estimator with a model
            `<mode>-<seed>.npz`, its history `.csv` and its settings `.json`.
        population: The population.
        workers: Processes.
    """

    folder: Path
    population: Population
    workers: int = 1

    def model_path(self, estimator: str, mode: Mode, seed: int) -> Path:
        """Where a trained model is."""
        return self.folder / short_name(estimator) / f"{mode}-{seed}.npz"

    def models(self, estimator: str, mode: Mode) -> list[Path]:
        """The trained models of an estimator and mode, one per seed."""
        found = (self.folder / short_name(estimator)).glob(f"{mode}-*.npz")
        return sorted(found, key=seed_of)

    def estimators(self) -> list[str]:
        """Estimators with a folder here: registered names, then plug-ins as `FILE.py:CLASS`."""
        names = [name for name in registered("estimator") if (self.folder / name).is_dir()]
        kept = sorted(self.folder.glob(f"*/{PLUGIN_FILE}"))
        return [*names, *(path.read_text(encoding="utf-8").strip() for path in kept)]

    def add_estimator(self, estimator: str) -> None:
        """Note where a plug-in is, for `estimators`.

        Raises:
            InputFileError: The folder of its name belongs to something else.
        """
        if not is_plugin(estimator):
            return
        name = short_name(estimator)
        kept = self.folder / name / PLUGIN_FILE
        own = f"{Path(plugin_file(estimator)).absolute()}:{name}"
        found = kept.read_text(encoding="utf-8").strip() if kept.exists() else own
        taken = kept.parent.exists() and not kept.exists()
        if taken or name in registered("estimator") or found != own:
            what = f"a folder of {found}" if found != own else f"a name that is taken, {name}"
            raise InputFileError(str(kept.parent), what, "a class with a name of its own")
        with atomic_output(kept) as path:
            path.write_text(own + "\n", encoding="utf-8")

    def cameras(self, seed: int = 0, progress: Progress = quiet) -> list[PopulationCamera]:
        """The cameras that training with this seed is about, made where they are not there yet."""
        population = self.population.of_draw(seed)
        return population_cameras(population, self.folder / CAMERAS, self.workers, progress)

    def trained_seeds(self, estimator: str) -> list[int]:
        """Seeds of all trained models of an estimator, ascending."""
        paths = [path for mode in MODES for path in self.models(estimator, mode)]
        return sorted({seed_of(path) for path in paths})


def seed_of(path: Path) -> int:
    """The seed in the name of a model."""
    return int(path.stem.rpartition("-")[2])


def open_study(folder: Path, population_file: Path | None = None, workers: int = 1) -> Study:
    """The study in a folder; with `population_file`, one for that population, begun if need be.

    Raises:
        InputFileError: No study there, or one of another population.
    """
    old, kept = folder / OLD_POPULATION_FILE, folder / POPULATION_FILE
    kept = old if old.exists() and not kept.exists() else kept
    if population_file is None:
        if not kept.exists():
            raise InputFileError(str(folder), "no population.yaml", "a folder of geoorbit train")
        return Study(folder, load_population(kept), workers)
    population = load_population(population_file)
    if kept.exists() and load_population(kept) != population:
        raise InputFileError(str(folder), "a study of another population", "a new folder")
    if not kept.exists():
        with atomic_output(kept) as path:
            path.write_bytes(population_file.read_bytes())
    return Study(folder, population, workers)


def train_study(
    study: Study,
    estimator: str,
    modes: Sequence[Mode],
    seeds: Sequence[int],
    settings: RunSettings,
    progress: Progress = quiet,
) -> dict[tuple[Mode, int], TrainedModel]:
    """Train one model per mode and seed, and write each; a rejected one becomes the defaults.

    A model is accepted only if it is better than the default parameters on the validation cameras,
    from which it has learned nothing (`federated.rounds.verdict`).

    Raises:
        InputFileError: No seen camera on which a lane can be found, or a plug-in whose name is
            taken.
    """
    study.add_estimator(estimator)
    models: dict[tuple[Mode, int], TrainedModel] = {}
    for draw in range(min(study.population.draws, len(seeds))):
        drawn = [seed for seed in seeds if seed % study.population.draws == draw]
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
    training, validating = split_seen_cameras(cameras)
    best = best_parameters(
        training, estimator, study.folder / CAMERAS, study.workers, progress=progress
    )
    examples = examples_of(training, best)
    if not examples:
        raise InputFileError(str(study.folder), "no seen camera with a lane", "more traffic")
    table = LossTable(
        {camera.camera_id: camera.path for camera in [*training, *validating]},
        estimator,
        "supervision",
        study.workers,
    )

    def composite(learner: MetaLearner, names: Sequence[str]) -> NDArray[np.float64]:
        asked = [(name, learner.predict_unit(examples[name].features[0])) for name in names]
        return np.array([losses.total for losses in table.losses(asked)])

    validation = validation_cameras(cameras, examples, table)
    models: dict[tuple[Mode, int], TrainedModel] = {}
    for mode in modes:
        for seed in seeds:
            chosen = replace(settings, seed=seed)
            what = f"training {mode} {seed} ({short_name(estimator)})"
            progress(what, 0.0)

            def show(entry: Round, what: str = what) -> None:
                progress(what, entry.number / (settings.rounds + 1))

            model = train(mode, examples, composite, chosen, show, validation)
            if not model.verdict.accepted:
                model = replace(model, learner=MetaLearner.untrained(seed))
            models[mode, seed] = model
            _write_model(study.model_path(estimator, mode, seed), model, chosen)
    return models


def validation_cameras(
    cameras: Sequence[PopulationCamera], examples: dict[str, Examples], table: LossTable
) -> ValidationCameras:
    """The validation cameras of a study; where all validate, those that also train."""
    seen = [camera for camera in cameras if camera.split == "seen"]
    divisor, _, names = roles([camera.camera_id for camera in seen])
    chosen = [
        camera
        for camera in seen
        if camera.camera_id in names and (divisor > 1 or camera.camera_id in examples)
    ]

    def gains(learner: MetaLearner) -> list[float]:
        asked = [(camera.camera_id, learner.predict_unit(camera.features)) for camera in chosen]
        fixed = [(camera.camera_id, DEFAULT_UNIT) for camera in chosen]
        losses = table.losses([*asked, *fixed])
        return gains_of(losses[: len(chosen)], losses[len(chosen) :])

    return ValidationCameras(tuple(camera.camera_id for camera in chosen), divisor, gains)


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
