"""What a reader did with a user's file: which rows were repaired or left out, and why.

Every reader follows one policy. What one row says is repaired, used or left out, and counted. A
file is refused only when nothing sensible can be made of it, or when most of it is bad.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import StrEnum

from geoorbit_ros.core.errors import InputFileError

MAX_LEFT_OUT_SHARE = 0.5
"""A file of which more rows than this are left out is refused. Chosen: most of a file must be
good before a result stands for it; smaller refuses recordings with long bad stretches."""

_COMMA = re.compile(r"[-+]?[0-9]+,[0-9]+")


class Treatment(StrEnum):
    """What was done with rows that are not as they should be."""

    REPAIRED = "repaired"
    LEFT_OUT = "left out"
    NOTED = "noted"
    """Used as they are; the reader should know."""
    DOUBTFUL = "doubtful"
    """Used as they are, but the result can't be trusted until somebody has looked."""


@dataclass(frozen=True, slots=True)
class Remark:
    """One kind of fault in a file.

    Attributes:
        treatment: What was done.
        count: How many rows it concerns; 0 when it concerns the file as a whole.
        text: What is wrong and what was done, as the rest of a sentence.
        example: The first row that shows it, with its place; empty for the file as a whole.
    """

    treatment: Treatment
    count: int
    text: str
    example: str = ""

    def sentence(self, total: int, things: str) -> str:
        """The remark in one sentence, e.g. `12 of 400 boxes left out: …`."""
        tail = f" (first: {self.example})" if self.example else ""
        if not self.count:
            return f"{self.text}{tail}"
        return f"{self.count} of {total} {things} {self.treatment.value}: {self.text}{tail}"


@dataclass(slots=True)
class InputReport:
    """All remarks on one file.

    Attributes:
        place: The file, as the user named it.
        things: What its rows are, in the plural: `boxes`, `control points`.
        total: How many rows it has.
        remarks: In the order in which they were found.
        image_size: (width, height) in pixels that boxes were held against, where it is known.
    """

    place: str
    things: str = "rows"
    total: int = 0
    remarks: list[Remark] = field(default_factory=list)
    image_size: tuple[int, int] | None = None

    def add(self, treatment: Treatment, count: int, text: str, example: str = "") -> None:
        """Note `count` rows of one kind; nothing is noted for none."""
        if count > 0:
            self.remarks.append(Remark(treatment, count, text, example))

    def note(self, treatment: Treatment, text: str, example: str = "") -> None:
        """Note something about the file as a whole."""
        self.remarks.append(Remark(treatment, 0, text, example))

    def include(self, other: InputReport) -> None:
        """Take over another report's remarks, on things of another kind, as remarks on the file."""
        for remark in other.remarks:
            text = remark.sentence(other.total, other.things)
            self.remarks.append(Remark(remark.treatment, 0, text))

    @property
    def left_out(self) -> int:
        """How many rows are not used."""
        return sum(r.count for r in self.remarks if r.treatment is Treatment.LEFT_OUT)

    @property
    def faults(self) -> list[Remark]:
        """Remarks on what is not as it should be."""
        return [r for r in self.remarks if r.treatment is not Treatment.NOTED]

    @property
    def doubtful(self) -> bool:
        """Whether something speaks against trusting what is made of this file."""
        return any(r.treatment is Treatment.DOUBTFUL for r in self.remarks)

    def sentences(self, *, doubts: bool = False) -> Iterator[str]:
        """One sentence per remark, or only per doubt."""
        for remark in self.remarks:
            if not doubts or remark.treatment is Treatment.DOUBTFUL:
                yield remark.sentence(self.total, self.things)

    def check(self, strict: bool, expected: str) -> None:
        """Refuse a file that is mostly bad, or, when `strict`, one with any fault.

        Args:
            strict: Whether rows may be repaired or left out at all.
            expected: What the file should have been, for the error.

        Raises:
            InputFileError: It is refused; the message names the first or the largest fault.
        """
        faults = self.faults
        if strict and faults:
            first = faults[0].sentence(self.total, self.things)
            raise InputFileError(self.place, f"{first}; not accepted with --strict", expected)
        if self.total and self.left_out > MAX_LEFT_OUT_SHARE * self.total:
            out = [r for r in faults if r.treatment is Treatment.LEFT_OUT]
            worst = max(out, key=lambda r: r.count).sentence(self.total, self.things)
            raise InputFileError(self.place, worst, expected)


def decimal_comma(value: object) -> float | None:
    """The number that a text with one decimal comma is; None for all else.

    Three digits after the comma may be thousands, so that is none.
    """
    if isinstance(value, str) and _COMMA.fullmatch(value) and len(value.partition(",")[2]) != 3:
        return float(value.replace(",", "."))
    return None
