"""One codec: what is written is read again, and damaged bytes are one named error."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from geoorbit_ros.core.cdr import MAX_ITEMS, CdrError, CdrReader, CdrWriter

KINDS = "bBhHiIqQfd"
TEXT = st.text(max_size=9).filter(lambda text: "\0" not in text)
FIELDS = st.one_of(
    st.tuples(st.just("text"), TEXT),
    st.tuples(st.just("texts"), st.lists(TEXT, max_size=3)),
    st.tuples(st.just("data"), st.binary(max_size=9)),
    st.tuples(st.just("header"), st.tuples(st.integers(0, 2**31 * 10**9 - 1), TEXT)),
    *(st.tuples(st.just(kind), st.integers(0, 100)) for kind in KINDS),
    *(st.tuples(st.just(2 * kind), st.lists(st.integers(0, 100), max_size=4)) for kind in KINDS),
)


def write(writer: CdrWriter, kind: str, value: object) -> None:
    match kind, value:
        case "text", str():
            writer.text(value)
        case "texts", list():
            writer.texts(value)
        case "data", bytes():
            writer.data(value)
        case "header", tuple():
            writer.header(*value)
        case _, list():
            writer.numbers(kind[0], value)
        case _, int():
            writer.number(kind, value)


def read(reader: CdrReader, kind: str) -> object:
    match kind:
        case "text":
            return reader.text()
        case "texts":
            return reader.texts()
        case "data":
            return bytes(reader.data())
        case "header":
            found = reader.header()
            reader.unpack(struct.Struct(""))  # the padding behind it
            return found
        case _ if len(kind) == 2:
            return reader.numbers(kind[0]).tolist()
        case _:
            return reader.number(kind)


def read_all(reader: CdrReader, fields: list[tuple[str, object]]) -> list[object]:
    return [read(reader, kind) for kind, _ in fields]


@given(st.lists(FIELDS, max_size=6))
def test_what_is_written_is_read_again(fields: list[tuple[str, object]]) -> None:
    writer = CdrWriter()
    for kind, value in fields:
        write(writer, kind, value)
    reader = CdrReader(writer.message(), "here")
    assert read_all(reader, fields) == [value for _, value in fields]
    reader.end()


@given(st.lists(FIELDS, min_size=1, max_size=6), st.data())
def test_cut_anywhere_it_is_one_named_error(
    fields: list[tuple[str, object]], data: st.DataObject
) -> None:
    writer = CdrWriter()
    for kind, value in fields:
        write(writer, kind, value)
    message = writer.message()
    reader = CdrReader(message[: data.draw(st.integers(4, len(message) - 1))], "topic /north/x")
    with pytest.raises(CdrError, match=r"topic /north/x: found .*, expected "):
        read_all(reader, fields)


def test_padding_is_zero() -> None:
    writer = CdrWriter()
    writer.number("B", 255)
    writer.number("d", 0.5)
    writer.text("a")
    writer.align(8)
    expected = b"\xff" + bytes(7) + struct.pack("<dI", 0.5, 2) + b"a\0" + bytes(2)
    assert writer.fields() == expected


@pytest.mark.parametrize(
    ("message", "said"),
    [
        (b"\x00\x00\x00\x00" + bytes(8), "encapsulation 0x0000"),
        (b"\x00\x01\x00\x00\x02\x00\x00\x00ab", "without its closing zero"),
        (b"\x00\x01\x00\x00\x02\x00\x00\x00\xff\x00", "not UTF-8"),
        (b"\x00\x01\x00\x00\xff\xff\xff\xff", "break off"),
    ],
)
def test_what_is_wrong_with_a_text(message: bytes, said: str) -> None:
    with pytest.raises(CdrError, match=said):
        CdrReader(message, "here").text()


def test_a_damaged_length_allocates_nothing() -> None:
    writer = CdrWriter()
    writer.number("I", MAX_ITEMS + 1)
    for take in (CdrReader.texts, lambda reader: reader.numbers("d")):
        with pytest.raises(CdrError, match=f"{MAX_ITEMS} at most"):
            take(CdrReader(writer.message(), "here"))
