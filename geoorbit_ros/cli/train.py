"""`geoorbit train`: a meta-learner from a population of cameras."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from geoorbit_ros.core.plugins import check_name, expected, registered


class ModeName(StrEnum):
    """How the meta-learner is trained."""

    CENTRAL = "central"
    FEDERATED = "federated"


def train(
    population: Annotated[
        Path, typer.Argument(help="Which cameras: a population file.", metavar="FLEET.yaml")
    ],
    out: Annotated[Path, typer.Option(help="Folder for cameras, models and their history.")],
    rounds: Annotated[int, typer.Option(min=1, max=10000, help="Most rounds.")] = 20,
    estimator: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME", help=f"{' or '.join(registered('estimator'))}; repeat it. Default: all."
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
        str, typer.Option(metavar="NAME", help=f"How weights travel: {expected('encoding')}.")
    ] = "float32",
    workers: Annotated[int, typer.Option(min=1, max=1024, help="Processes.")] = 2,
) -> None:
    """Train the meta-learner that predicts each camera's detection parameters.

    The population's cameras are simulated once and kept in OUT/cameras, their best parameters are
    searched once, then the model learns to predict these from the scene: with all data in one place
    (central) and through the federated server and its wire format (federated).

    Example: [bold]geoorbit train params/studies/small.yaml --rounds 20 --out study[/bold],
    then [bold]geoorbit evaluate --out study[/bold]
    """
    from geoorbit_ros.cli.console import console, make_table, shown_progress
    from geoorbit_ros.learning.study import open_study, train_study
    from geoorbit_ros.learning.training import RunSettings

    names = estimator or list(registered("estimator"))
    for name in names:
        check_name("estimator", name)
    check_name("strategy", strategy)
    check_name("encoding", encoding)
    study = open_study(out, population, workers)
    settings = RunSettings(
        rounds=rounds,
        stop_below=float("nan") if stop_below is None else stop_below,
        clients_per_round=clients_per_round,
        strategy=strategy,
        encoding=encoding,
    )
    table = make_table(
        f"Population {study.population.name}",
        "estimator|mode|>seed|>rounds|>L_param|>L_total|>kB|verdict",
    )
    for name in names:
        with shown_progress() as progress:
            models = train_study(
                study,
                name,
                [m.value for m in mode or list(ModeName)],
                range(seeds),
                settings,
                progress,
            )
        for (kind, seed), model in models.items():
            first, last = model.rounds[0], model.rounds[-1]
            table.add_row(
                name,
                kind,
                str(seed),
                str(last.number - 1),
                f"{first.parameter_loss:.2f} → {last.parameter_loss:.2f}",
                f"{first.composite_loss:.4g} → {last.composite_loss:.4g}",
                f"{model.traffic.total_bytes / 1e3:.0f}" if model.traffic.total_bytes else "–",
                "better" if model.verdict.accepted else "[yellow]no gain[/]",
            )
    console.print(table)
    console.print(f" Wrote {out}; next: geoorbit evaluate --out {out}", soft_wrap=True)
