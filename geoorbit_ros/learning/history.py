"""What training did, round by round, and its file."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.storage.atomic import atomic_output


@dataclass(frozen=True, slots=True)
class Round:
    """The model before a round's training, over all seen cameras.

    Attributes:
        number: From 1.
        parameter_loss: Mean L_param.
        parameter_loss_std: Its standard deviation over the cameras.
        composite_loss: Mean L_total.
    """

    number: int
    parameter_loss: float
    parameter_loss_std: float
    composite_loss: float


def save_history(rounds: Sequence[Round], path: Path) -> None:
    """Write the rounds as CSV."""
    with atomic_output(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as f:
        writer = csv.writer(f)
        writer.writerow(field.name for field in fields(Round))
        writer.writerows(astuple(entry) for entry in rounds)


def load_history(path: Path) -> list[Round]:
    """Read what `save_history` wrote.

    Raises:
        InputFileError: Not such a file.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            header, *rows = list(csv.reader(file))
        if header != [field.name for field in fields(Round)]:
            raise InputFileError(str(path), f"columns {header}", "a history of geoorbit train")
        return [Round(int(row[0]), *map(float, row[1:])) for row in rows]
    except (OSError, ValueError) as error:
        raise InputFileError(str(path), error, "a history of geoorbit train") from error
