"""`geoorbit train`, `evaluate` and `federation`: a meta-learner from a population of cameras."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from geoorbit_ros.core.plugins import check_name, expected, is_plugin, registered, short_name

if TYPE_CHECKING:
    from geoorbit_ros.learning.study import Study
    from geoorbit_ros.learning.training import Mode, RunSettings, TrainedModel

federation = typer.Typer(
    no_args_is_help=True, help="Keys of a federation, and how much privacy its settings give."
)


class ModeName(StrEnum):
    """How the meta-learner is trained."""

    CENTRAL = "central"
    FEDERATED = "federated"


def train(
    population: Annotated[
        Path, typer.Argument(help="The study file: which cameras.", metavar="STUDY.yaml")
    ],
    out: Annotated[Path, typer.Option(help="Folder for cameras, models and their history.")],
    rounds: Annotated[int, typer.Option(min=1, max=10000, help="Most rounds.")] = 20,
    estimator: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME", help=f"{expected('estimator')}; repeat it. Default: all built-in ones."
        ),
    ] = None,
    mode: Annotated[
        list[ModeName] | None,
        typer.Option(metavar="NAME", help="central or federated; repeat it. Default: both."),
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, max=1000, help="Train that many models each.")] = 1,
    stop_below: Annotated[
        float | None,
        typer.Option(metavar="LOSS", help="End once the mean total loss is not above this."),
    ] = None,
    clients_per_round: Annotated[
        int, typer.Option(min=0, help="Cameras that train in a federated round; 0: all.")
    ] = 0,
    strategy: Annotated[
        str,
        typer.Option(metavar="NAME", help=f"How the server aggregates: {expected('strategy')}."),
    ] = "fedavg",
    encoding: Annotated[
        str, typer.Option(metavar="NAME", help=f"How weights are packed: {expected('encoding')}.")
    ] = "float32",
    workers: Annotated[int, typer.Option(min=1, max=1024, help="Processes.")] = 2,
) -> None:
    """Train the meta-learner that predicts each camera's lane-estimator parameters θ.

    The study's cameras are simulated once and kept in OUT/cameras, their best parameters are
    searched once, then the model learns to predict these from the scene: with all data in one place
    (central) and through the federated server and its wire format (federated).

    Example: [bold]geoorbit train params/studies/small.yaml --rounds 20 --out study[/bold],
    then [bold]geoorbit evaluate --out study[/bold]
    """
    from geoorbit_ros.cli.console import as_typed, console
    from geoorbit_ros.learning.study import open_study
    from geoorbit_ros.learning.training import RunSettings

    names = _checked(estimator, strategy, encoding)
    study = open_study(out, population, workers)
    settings = RunSettings(
        rounds=rounds,
        stop_below=float("nan") if stop_below is None else stop_below,
        clients_per_round=clients_per_round,
        strategy=strategy,
        encoding=encoding,
    )
    _train(study, names, [m.value for m in mode or list(ModeName)], range(seeds), settings)
    then = as_typed(f"evaluate --out {out}")
    console.print(f" Wrote {out}. Next: {then}", soft_wrap=True)


def _train(
    study: Study, names: list[str], modes: list[Mode], seeds: range, settings: RunSettings
) -> None:
    """Train for each estimator, mode and seed, and print one row for each."""
    from geoorbit_ros.cli.console import console, make_table, shown_progress
    from geoorbit_ros.learning.study import train_study

    title = f"Population {study.population.name}"
    table = make_table(title, "estimator|mode|>seed|>rounds|>L_param|>L_total|>kB|verdict")
    for name in names:
        with shown_progress() as progress:
            models = train_study(study, name, modes, seeds, settings, progress)
        for (kind, seed), model in models.items():
            table.add_row(short_name(name), kind, str(seed), *_model_row(model))
    console.print(table)


def _checked(estimators: list[str] | None, strategy: str, encoding: str) -> list[str]:
    """Names of the estimators to train for.

    Raises:
        ParameterError: A name that isn't registered, or a plug-in that can't be used.
    """
    from geoorbit_ros.federated.strategies.strategy import make_strategy
    from geoorbit_ros.lanes.estimators.estimator import make_estimator

    names = estimators or list(registered("estimator"))
    for name in names:
        check_name("estimator", name)
        if is_plugin(name):
            make_estimator(name)
    check_name("strategy", strategy)
    if is_plugin(strategy):
        make_strategy(strategy)
    check_name("encoding", encoding)
    return names


def _model_row(model: TrainedModel) -> list[str]:
    """Rounds, losses at the beginning and the end, bytes, and the validation's verdict."""
    first, last = model.rounds[0], model.rounds[-1]
    return [
        str(last.number - 1),
        f"{first.parameter_loss:.2f} → {last.parameter_loss:.2f}",
        f"{first.composite_loss:.4g} → {last.composite_loss:.4g}",
        f"{model.traffic.total_bytes / 1e3:.0f}" if model.traffic.total_bytes else "–",
        "better" if model.verdict.accepted else "[yellow]no gain[/]",
    ]


def evaluate(
    out: Annotated[Path, typer.Option(help="The folder that geoorbit train has filled.")],
    workers: Annotated[int, typer.Option(min=1, max=1024, help="Processes.")] = 2,
) -> None:
    """Measure the fixed parameters and the trained models on seen and unseen cameras.

    Into OUT/evaluation go the paper's tables of losses and of communication, the errors against the
    true lanes, and the loss figures: tables.md, CSV files and figures.

    Example: [bold]geoorbit evaluate --out study[/bold]
    """
    from geoorbit_ros.cli.console import console, make_table, shown_progress
    from geoorbit_ros.core.errors import InputFileError
    from geoorbit_ros.learning import study_report as study_tables
    from geoorbit_ros.learning.evaluation import evaluate as measure
    from geoorbit_ros.learning.study import open_study
    from geoorbit_ros.learning.study_report import draw_losses

    study = open_study(out, workers=workers)
    folder = out / "evaluation"
    trained = study.estimators()
    if not trained:
        raise InputFileError(str(out), "no trained model", "geoorbit train first")
    tables = {}
    for estimator in trained:
        name = short_name(estimator)
        with shown_progress() as progress:
            rows = measure(study, estimator, progress)
        tables[f"losses-{name}"] = study_tables.loss_table(rows, name)
        tables[f"errors-{name}"] = study_tables.error_table(rows, name)
        tables[f"recordings-{name}"] = study_tables.recording_table(rows, name)
        tables[f"communication-{name}"] = study_tables.communication_table(study, name)
        draw_losses(study, name, folder)
        losses = tables[f"losses-{name}"]
        shown = make_table(losses.title, "|".join(losses.header[:2] + losses.header[6:]))
        for row in losses.rows:
            shown.add_row(*row[:2], *row[6:])
        console.print(shown)
    study_tables.write_tables(tables, folder)
    console.print(f" Wrote {folder}", soft_wrap=True)


@federation.command("key")
def key(
    file: Annotated[Path, typer.Argument(help="New file for the private key.")],
) -> None:
    """Make a key: the private half goes to a file, the public half is printed.

    The line that is printed belongs on the server's roster, with the camera's name for the file's.
    The file can only be read by its owner, and is never replaced.

    Example: [bold]geoorbit federation key north.key >> roster.txt[/bold]
    """
    from geoorbit_ros.federated.keys import write_private_key

    typer.echo(f"{file.stem} {write_private_key(file).hex()}")


@federation.command("epsilon")
def epsilon(
    noise: Annotated[float, typer.Argument(help="noise_multiplier of federated_server.")],
    rounds: Annotated[int, typer.Argument(help="Rounds that a camera takes part in.")],
    delta: Annotated[
        float, typer.Option("--delta", help="Probability with which the bound may fail.")
    ] = 1e-5,
) -> None:
    """Say what differential privacy a camera has: epsilon at delta.

    Example: [bold]geoorbit federation epsilon 4 20[/bold]
    """
    from geoorbit_ros.federated.privacy.differential import epsilon as privacy_loss

    typer.echo(f"epsilon = {privacy_loss(noise, rounds, delta):.2f} at delta = {delta:g}")
