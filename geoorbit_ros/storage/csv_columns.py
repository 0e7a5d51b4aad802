"""Columns of numbers out of a CSV file: read in bulk; errors name the cell."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
from numpy.typing import NDArray

from geoorbit_ros.core.errors import InputFileError

_NO_ROW = ("no row below the header", "at least one row")
_NUMBER = re.compile(r"\s*[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\s*")


@dataclass(frozen=True, slots=True)
class CsvColumns:
    """Columns of one CSV file.

    Attributes:
        path: The file, as the user named it.
        names: All columns of the file, in its order.
        header_line: Line number of the header, from 1.
        values: (N,) array per requested column; all values are finite.
    """

    path: str
    names: tuple[str, ...]
    header_line: int
    values: Mapping[str, NDArray[Any]]

    def fail(self, row: int, column: str, expected: str, found: str = "") -> NoReturn:
        """Raise an error at row `row` (from 0); `found` defaults to the text in the file."""
        for k, (number, cells) in enumerate(_data_lines(self.path, self.header_line)):
            if k == row:
                text = found or _quoted(cells[self.names.index(column)])
                raise InputFileError(
                    f"{self.path}, line {number}, column '{column}'", text, expected
                )
        raise InputFileError(f"{self.path}, row {row + 1}", "a file that changed", expected)


def read_columns(path: str | Path, types: Mapping[str, pa.DataType], what: str) -> CsvColumns:
    """Read the columns named in `types`; others may be there and are ignored.

    Args:
        path: UTF-8 CSV file with a header line, comma-separated.
        types: Arrow number type per column.
        what: What the file is, for the error, e.g. "a CSV file of tracks".

    Raises:
        InputFileError: No file, not text, no row, a missing column, a cell that is not a finite
            number; names file, line and column.
    """
    place = str(path)
    expected = f"{what} with the columns {','.join(types)}"
    names, header_line = _header(place, expected)
    missing = [name for name in types if name not in names]
    if missing:
        found = ",".join(names)
        raise InputFileError(
            f"{place}, line {header_line}",
            f"no column '{missing[0]}' in '{found if len(found) < 200 else found[:200] + '...'}'",
            f"the columns {','.join(types)}",
        )
    options = pacsv.ConvertOptions(column_types=dict(types), include_columns=list(types))
    layout = pacsv.ReadOptions(column_names=list(names), skip_rows=header_line)
    try:
        table = pacsv.read_csv(place, read_options=layout, convert_options=options)
    except pa.ArrowInvalid as error:
        if next(_data_lines(place, header_line), None) is None:
            raise InputFileError(place, *_NO_ROW) from None
        _name_fault(place, names, header_line, types)
        raise InputFileError(place, str(error).split("\n")[0], expected) from None
    columns = CsvColumns(
        place, names, header_line, {name: table[name].to_numpy() for name in types}
    )
    if table.num_rows == 0:
        raise InputFileError(place, *_NO_ROW)
    for name, values in columns.values.items():
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            columns.fail(int(np.argmin(np.isfinite(values))), name, "a finite number")
    return columns


def _header(place: str, expected: str) -> tuple[tuple[str, ...], int]:
    """Column names, and the line they stand on."""
    path = Path(place)
    if not path.exists():
        raise InputFileError(place, "no such file", expected)
    try:
        with path.open("rb") as file:
            start = file.read(1 << 16)
    except OSError as error:
        raise InputFileError(place, str(error.strerror), expected) from None
    if not start.strip():
        raise InputFileError(place, "an empty file", expected)
    head = start.decode("utf-8-sig", errors="replace")
    lines = head.splitlines()
    number = next(k for k, line in enumerate(lines) if line.strip())
    if "\0" in head or "�" in lines[number]:
        raise InputFileError(place, "binary data", expected)
    return tuple(name.strip() for name in next(csv.reader([lines[number]]))), number + 1


def _data_lines(place: str, header_line: int) -> Iterator[tuple[int, list[str]]]:
    """Line number and cells of every line with content below the header."""
    with open(place, encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, 1):
            if number > header_line and line.strip("\r\n"):
                yield number, next(csv.reader([line.replace("\0", "�").rstrip("\r\n")]))


def _name_fault(
    place: str, names: tuple[str, ...], header_line: int, types: Mapping[str, pa.DataType]
) -> None:
    """Find the line that the bulk reader refused; cell by cell, so only after a refusal."""
    index = [(name, names.index(name)) for name in types]
    for number, cells in _data_lines(place, header_line):
        where = f"{place}, line {number}"
        if len(cells) != len(names):
            raise InputFileError(
                where, f"{len(cells)} cells", f"{len(names)} as in the header (is it cut short?)"
            )
        for name, k in index:
            if not _NUMBER.fullmatch(cells[k]):
                raise InputFileError(
                    f"{where}, column '{name}'", _quoted(cells[k]), "a finite number"
                )


def _quoted(text: str) -> str:
    """The cell in quotes, without control characters, not too long to read."""
    return repr(text if len(text) < 60 else text[:60] + "...")
