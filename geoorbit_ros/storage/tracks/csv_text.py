"""CSV text of any spelling as columns of text, with the line that each row stands on.

UTF-8 and UTF-16 with or without a byte order mark; commas, semicolons or tabs; decimal commas;
blank lines, comment lines, commas at the end of lines. Lines of another length than the header are
left out and counted.
"""

from __future__ import annotations

import codecs
import csv
import io
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pacsv
from numpy.typing import NDArray

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.input_report import InputReport, Treatment

DELIMITERS = (",", ";", "\t")
_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_NUMBER = r"^[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?$"
_MARKS_APART = "['\u2019\u00a0\u202f\u2009 ]"
_APART = rf"^[+-]?\d{{1,3}}({_MARKS_APART}\d{{3}})+([.,]\d+)?$"
"""Thousands kept apart by apostrophes (Switzerland) or narrow blanks (France, ISO 80000)."""
_DECIMAL_COMMA = r"^[+-]?\d*,\d+$"
_DECIMALS = {".": r"\d+\.(?:\d{1,2}|\d{4,})", ",": r"\d+,(?:\d{1,2}|\d{4,})"}
"""Numbers with decimals for certain: three digits may be thousands."""
_GROUPED = {".": r"[1-9]\d{0,2}(?:\.\d{3})+(?:,\d+)?", ",": r"[1-9]\d{0,2}(?:,\d{3})+(?:\.\d+)?"}
"""Numbers whose thousands are separated by this mark, if the other one is the decimals'."""
WHOLE_SHARE, LEAST_BESIDE = 0.1, 100.0
"""Share of whole numbers in a column whose others have marks between thousands, and the least that
one of them must reach. Chosen: of numbers with three decimals one in a thousand is whole."""
_EXCEL_LINE = re.compile(r"sep=.?", re.IGNORECASE)
"""A first line that tells Excel the delimiter and is no header."""
_BLANKS = re.compile(r"(?<=\S)[ \t]+(?=\S)")
"""Between values of a line without any other delimiter."""
_CONTENT, _FIRST_ROW = re.compile(r"\S"), re.compile(r"^.*\S.*$", re.MULTILINE)
_AROUND_VALUES = '" \t\v\f\x1c\x1d\x1e\x1f'
"""ASCII blanks, and quotes, in which line ends may be: without any of them nothing is to trim."""
_NEWLINE, _RETURN = 10, 13


@dataclass(frozen=True, slots=True)
class CsvText:
    """The columns of a CSV file.

    Attributes:
        names: As the header has them, without blanks around them.
        columns: (N,) text per column, in the order of `names`, without blanks around it.
        line: (N,) line number of each row, from 1.
        report: Lines that were left out.
    """

    names: tuple[str, ...]
    columns: tuple[pa.Array, ...]
    line: NDArray[np.int64]
    report: InputReport

    def numbers(self, name: str) -> NDArray[np.float64]:
        """(N,) a column as numbers, NaN where there is none."""
        return as_numbers(self.columns[self.names.index(name)])

    def words(self, name: str) -> pa.StringArray:
        """(N,) a column as text."""
        return self.columns[self.names.index(name)]


def as_numbers(text: pa.Array) -> NDArray[np.float64]:
    """(N,) numbers, NaN where a text is none; `3,5` counts as 3.5, `1'706` as 1706."""
    try:
        return np.array(pc.cast(text, pa.float64()), dtype=np.float64)
    except pa.ArrowInvalid:
        apart = pc.match_substring_regex(text, _APART)
        text = pc.if_else(apart, pc.replace_substring_regex(text, _MARKS_APART, ""), text)
        commas = pc.match_substring_regex(text, _DECIMAL_COMMA)
        text = pc.if_else(commas, pc.replace_substring(text, ",", "."), text)
        good = pc.match_substring_regex(text, _NUMBER)
        numbers = pc.cast(pc.if_else(good, text, pa.scalar(None, pa.string())), pa.float64())
        return np.array(pc.fill_null(numbers, float("nan")), dtype=np.float64)


def decode(data: bytes, place: str, expected: str) -> str:
    """Text of a file in UTF-8 or UTF-16, with line feeds as line ends.

    Raises:
        InputFileError: Empty, or no text.
    """
    if not data.strip(b"\0\xef\xbb\xbf\xff\xfe \t\r\n"):
        raise InputFileError(place, "an empty file", expected)
    encoding = next((name for mark, name in _MARKS if data.startswith(mark)), "utf-8")
    if encoding == "utf-8" and data[1:2] == b"\0":
        encoding = "utf-16-le"
    elif encoding == "utf-8" and data[:1] == b"\0":
        encoding = "utf-16-be"
    text = data.decode(encoding, errors="replace")
    if "\r" in text:
        text = text.replace("\r\n", "\n").replace("\r", "\n")
    if "\0" in text[:4096] or text[:4096].count("�") > 0.05 * len(text[:4096]):
        raise InputFileError(place, "binary data", expected)
    return text


@dataclass(frozen=True, slots=True)
class CsvBody:
    """A CSV file as text, taken apart.

    Attributes:
        names: As the header has them, without blanks around them.
        delimiter: Between the values of a line.
        body: All lines below the header, with line feeds.
        header_line: The header's line number, from 1.
        comments: Lines above the header that begin with `#`.
        repaired: What was changed in the body, empty for nothing.
    """

    names: tuple[str, ...]
    delimiter: str
    body: str
    header_line: int
    comments: tuple[str, ...]
    repaired: str = ""


def split_header(path: Path, expected: str) -> CsvBody:
    """Read a text file of any encoding and find its header.

    Args:
        path: The file.
        expected: What it should be, for errors.

    Raises:
        InputFileError: No file, no text, or no row below the header.
    """
    place = str(path)
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise InputFileError(place, "no such file", expected) from None
    except OSError as error:
        raise InputFileError(place, error.strerror or str(error), expected) from None
    text = decode(data, place, expected)
    header, header_line, comments, body = first_line(text)
    if not _CONTENT.search(body):
        raise InputFileError(place, "no row below the header", "at least one row")
    delimiter = max(DELIMITERS, key=header.count)
    if delimiter not in header and len(header.split()) > 1:
        header, body = _BLANKS.sub(";", header), _BLANKS.sub(";", body)
        delimiter = ";"
    names = tuple(name.strip() for name in next(csv.reader([header], delimiter=delimiter)))
    repaired = ""
    if delimiter != "," or '"' in body:
        body, repaired = _without_thousands(body, delimiter)
    return CsvBody(names, delimiter, body, header_line, comments, repaired)


def _without_thousands(body: str, delimiter: str) -> tuple[str, str]:
    """Numbers without the marks between their thousands, and what was done.

    `1.275` is 1275 where decimals have commas, and 1.275 elsewhere; a file with both is left.
    """

    def values(pattern: str, has_comma: bool = True) -> re.Pattern[str]:
        if delimiter == "," and has_comma:  # within quotes
            return re.compile(rf'(?<="){pattern}(?=")')
        beside = r"\w.:/" if delimiter == "," else r"\w.,:/"
        return re.compile(rf"(?<![{beside}])[+-]?{pattern}(?![{beside}])")

    for mark, decimal in ((".", ","), (",", ".")):
        grouped = values(_GROUPED[mark])
        numbers = grouped.findall(body)
        of_other, of_same = (values(_DECIMALS[m], m == ",") for m in (decimal, mark))
        if numbers and of_other.search(body) and not of_same.search(body):
            plain = [number.replace(mark, "") for number in numbers]
            parts = grouped.split(body)
            body = "".join(a + b for a, b in zip(parts, [*plain, ""], strict=True))
            text = f"{len(numbers)} numbers have marks between thousands"
            return body, f"{text}: {numbers[0]} is {plain[0]}"
    return body, ""


def first_line(text: str) -> tuple[str, int, tuple[str, ...], str]:
    """The first line that is neither blank, a comment nor Excel's `sep=`.

    Args:
        text: Lines ended by line feeds.

    Returns:
        The line, empty for none; its number, from 1; the comments above it; all below it.
    """
    comments = []
    at = number = 0
    while at < len(text):
        end = text.find("\n", at)
        end = len(text) if end < 0 else end
        line, at, number = text[at:end].strip(), end + 1, number + 1
        if line.startswith("#"):
            comments.append(line)
        elif line and not _EXCEL_LINE.fullmatch(line):
            return line, number, tuple(comments), text[at:]
    return "", number, tuple(comments), ""


def read_csv_text(path: Path, expected: str) -> CsvText:
    """All columns of a CSV file with a header.

    Args:
        path: The file.
        expected: What it should be, for errors.

    Raises:
        InputFileError: No file, no text, or no row below the header.
    """
    found = split_header(path, expected)
    names, delimiter, body = found.names, found.delimiter, found.body
    found_row = _FIRST_ROW.search(body)
    first = found_row[0] if found_row else ""
    if first.count(delimiter) == len(names) and first.rstrip().endswith(delimiter):
        body = re.sub(rf"{re.escape(delimiter)}[ \t]*(?=\r?$)", "", body, flags=re.MULTILINE)
    report = InputReport(str(path), "boxes")
    if found.repaired:
        report.note(Treatment.REPAIRED, found.repaired)
    return _table(body, names, delimiter, found.header_line, report)


def _table(
    body: str, names: tuple[str, ...], delimiter: str, header_line: int, report: InputReport
) -> CsvText:
    data = body.encode()
    bad: list[int] = []

    def skip(row: pacsv.InvalidRow) -> str:
        blank = not row.text.strip(" \t\r\n" + delimiter) or row.text.lstrip().startswith("#")
        bad.append(-row.number if blank else row.number)
        return "skip"

    table = _parsed(data, len(names), delimiter, quoted='"' in body, skip=skip)
    columns = [table[name].combine_chunks().cast(pa.string()) for name in table.column_names]
    if not body.isascii() or any(mark in body for mark in _AROUND_VALUES):
        columns = [pc.utf8_trim_whitespace(column) for column in columns]
    lines = _content_lines(data)
    # Rows are numbered from 1 among the lines that are not empty.
    keep = np.ones(len(lines), dtype=np.bool_)
    keep[[abs(number) - 1 for number in bad]] = False
    line = lines[keep] + header_line
    if len(line) != len(columns[0]):  # line breaks inside quotes: rows are counted instead
        line = np.arange(1, len(columns[0]) + 1) + header_line
    wrong = [number for number in bad if number > 0]
    blank = np.ones(len(line), dtype=np.bool_)
    for column in columns:
        blank &= np.array(pc.equal(column, ""), dtype=np.bool_)
        if not blank.any():
            break
    if blank.any():
        columns = [column.filter(pa.array(~blank)) for column in columns]
        line = line[~blank]
    report.total = len(line) + len(wrong)
    if wrong:
        at = int(lines[wrong[0] - 1] + header_line)
        example = f"line {at}"
        report.add(
            Treatment.LEFT_OUT, len(wrong), f"not {len(names)} values as in the header", example
        )
    # Without quotes a value can't hold the delimiter.
    marks = [mark for mark in (".", ",") if mark != delimiter or '"' in body]
    columns = [
        _without_marks(column, name, marks, report)
        for column, name in zip(columns, names, strict=True)
    ]
    return CsvText(names, tuple(columns), line.astype(np.int64), report)


def _parsed(
    data: bytes,
    count: int,
    delimiter: str,
    *,
    quoted: bool,
    skip: Callable[[pacsv.InvalidRow], str],
) -> pa.Table:
    """Columns of text; rows with too few or too many values are given to `skip`."""
    # Names may repeat or be missing in a header; pyarrow needs them unique.
    unique = [f"{k}" for k in range(count)]

    def read(handler: Callable[[pacsv.InvalidRow], str] | None) -> pa.Table:
        return pacsv.read_csv(
            io.BytesIO(data),
            # Threads don't number the rows that they hand over.
            read_options=pacsv.ReadOptions(column_names=unique, use_threads=handler is None),
            parse_options=pacsv.ParseOptions(
                delimiter=delimiter, invalid_row_handler=handler, newlines_in_values=quoted
            ),
            convert_options=pacsv.ConvertOptions(
                column_types=dict.fromkeys(unique, pa.string()), strings_can_be_null=False
            ),
        )

    try:
        return read(None)
    except pa.ArrowInvalid:
        return read(skip)


def _without_marks(text: pa.Array, name: str, marks: list[str], report: InputReport) -> pa.Array:
    """A column in which numbers below a thousand are whole, and larger ones have marks.

    `976` beside `1.706`: no program writes 1.706 so, and whole numbers beside it without decimals.
    """
    for mark in marks:
        marked = pc.match_substring(text, mark)
        count = pc.sum(marked).as_py() or 0
        if not 0 < count <= (1.0 - WHOLE_SHARE) * len(text):
            continue
        grouped = pc.match_substring_regex(
            text, rf"^[+-]?[1-9]\d{{0,2}}(?:{re.escape(mark)}\d{{3}})+$"
        )
        if pc.sum(grouped).as_py() != count:
            continue
        whole = as_numbers(text.filter(pc.invert(marked)))
        if np.isfinite(whole).any() and np.nanmax(np.abs(whole)) >= LEAST_BESIDE:
            found = text.filter(grouped)[0].as_py()
            told = f"column '{name}' has marks between thousands: {found} is "
            report.note(Treatment.REPAIRED, told + found.replace(mark, ""))
            return pc.replace_substring(text, mark, "")
    return text


def _content_lines(data: bytes) -> NDArray[np.int64]:
    """Numbers, from 1, of the lines that are not empty."""
    text = np.frombuffer(data, np.uint8)
    ends = np.flatnonzero(text == _NEWLINE)
    starts = np.concatenate([[0], ends + 1])
    stops = np.append(ends, len(text))
    before = np.maximum(stops - 1, 0)
    length = stops - starts - ((stops > starts) & (text[before] == _RETURN))
    return np.flatnonzero(length > 0) + 1
