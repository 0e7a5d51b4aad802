"""`geoorbit evaluate`: what training brought, on cameras that took part and on others."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def evaluate(
    out: Annotated[Path, typer.Option(help="The folder that geoorbit train has filled.")],
    workers: Annotated[int, typer.Option(min=1, max=1024, help="Processes.")] = 2,
) -> None:
    """Measure the fixed parameters and the trained models on seen and unseen cameras.

    Into OUT/evaluation go the paper's tables of losses and of communication, the errors against the
    true lanes, and the loss figures: tables.md, CSV files and pictures.

    Example: [bold]geoorbit evaluate --out study[/bold]
    """
    from geoorbit_ros.cli.console import console, make_table, shown_progress
    from geoorbit_ros.core.errors import InputFileError
    from geoorbit_ros.core.plugins import registered
    from geoorbit_ros.learning import study_report as study_tables
    from geoorbit_ros.learning.evaluation import evaluate as measure
    from geoorbit_ros.learning.study import open_study
    from geoorbit_ros.learning.study_report import draw_losses

    study = open_study(out, workers=workers)
    folder = out / "evaluation"
    trained = [name for name in registered("estimator") if (out / name).is_dir()]
    if not trained:
        raise InputFileError(str(out), "no trained model", "geoorbit train first")
    tables = {}
    for name in trained:
        with shown_progress() as progress:
            rows = measure(study, name, progress)
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
