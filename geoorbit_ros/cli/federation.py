"""`geoorbit federation`: keys, and how much privacy the settings give."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(
    no_args_is_help=True, help="Keys of a federation, and how much privacy its settings give."
)


@app.command("key")
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


@app.command("epsilon")
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
