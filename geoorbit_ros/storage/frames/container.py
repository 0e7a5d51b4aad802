"""What a video file says about itself: container, codec, length, when it was made, where it ends.

OpenCV tells none of this, and takes a file that breaks off for one that ends. Only headers are
read. Sources: ISO/IEC 14496-12 (MP4, MOV), RFC 9559 (Matroska, WebM), Microsoft's "AVI RIFF File
Reference" and "Advanced Systems Format", RFC 3533 (Ogg), Adobe's "Video File Format" (FLV).
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

from geoorbit_ros.core.errors import GeoOrbitError

_HEAD_BYTES = 4096
"""Of a file's beginning that tell its kind. Chosen: larger reads more, smaller takes a transport
stream with a long preface for something else."""
_MAX_INDEX_BYTES = 1 << 28
"""A larger index of an MP4 file is not read. Chosen: a day at 30 frames/s has 50 MB."""
_TAIL_BYTES = 1 << 16
"""Of a file's end in which the last page of an Ogg stream is searched: more than a page can have
(RFC 3533, section 6)."""


@dataclass(frozen=True, slots=True)
class Container:
    """What a file's headers say.

    Attributes:
        kind: Its format, as words; empty: not known here.
        video: Whether there is video in it; None when that is not known.
        codec: How the video is encoded; empty when that is not known.
        timed: Whether its images have times of their own.
        length_s: How long its video is, by the header that players go by; None: not said.
        announced_bytes: How long the file should be; None: not said.
        whole: Whether the file ends where it says; None: it doesn't say.
        indexed: Whether what a player needs first is there.
        created_ns: When it was made, nanoseconds since 1970; None: not said.
    """

    kind: str = ""
    video: bool | None = None
    codec: str = ""
    timed: bool = True
    length_s: float | None = None
    announced_bytes: int | None = None
    whole: bool | None = None
    indexed: bool = True
    created_ns: int | None = None


_Reader = Callable[[BinaryIO, int, Container], Container]
"""Reads what headers say, from a file of a size and the kind that is known already."""


def read_container(path: Path) -> Container:
    """What the headers of a file say; of one whose headers make no sense, the kind alone.

    Raises:
        GeoOrbitError: The file can't be read.
    """
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
            size = path.stat().st_size
            kind, reader = _kind(head)
            if reader is None:
                return kind
            try:
                return reader(file, size, kind)
            except (struct.error, IndexError, ValueError, OverflowError):
                return kind  # damaged headers: FFmpeg may still make something of them
    except OSError as error:
        expected = "a file that can be read"
        raise GeoOrbitError(str(path), error.strerror or str(error), expected) from None


_OTHER = (
    (b"%PDF", "a PDF document"),
    (b"PK\x03\x04", "a ZIP archive"),
    (b"\x1f\x8b", "a gzip archive"),
    (b"Rar!", "a RAR archive"),
    (b"version https://git-lfs", "a Git LFS pointer, not the file itself"),
    (b"<!DOCTYPE", "a web page"),
    (b"<!doctype", "a web page"),
    (b"<html", "a web page"),
    (b"<?xml", "XML"),
    (b"#EXTM3U", "a playlist"),
)
_SOUND = (b"ID3", b"fLaC", b"\xff\xfb", b"\xff\xf3", b"\xff\xf1", b"#!AMR")
_EBML, _ASF = b"\x1a\x45\xdf\xa3", bytes.fromhex("3026b2758e66cf11a6d900aa0062ce6c")
_BOXES = frozenset(
    b"ftyp moov mdat free skip wide moof mfra sidx styp uuid meta pnot udta emsg prft".split()
)


def _kind(head: bytes) -> tuple[Container, _Reader | None]:
    """The format by a file's first bytes, and who reads its headers."""
    riff = head[8:12] if head[:4] == b"RIFF" else b""
    known: tuple[tuple[bool, str, _Reader], ...] = (
        (head[4:8] in _BOXES, "MP4", _read_mp4),
        (head.startswith(_EBML) and b"webm" in head[:64], "WebM", _read_matroska),
        (head.startswith(_EBML), "Matroska", _read_matroska),
        (riff == b"AVI ", "AVI", _read_avi),
        (head.startswith(_ASF), "Windows Media", _read_asf),
        (head[:3] == b"FLV", "Flash video", _read_flv),
        (head[:4] == b"OggS", "Ogg", _read_ogg),
    )
    for fits, kind, reader in known:
        if fits:
            return Container(kind), reader
    if head.startswith(_SOUND) or riff == b"WAVE":
        return Container("sound", video=False), None
    text = head.lstrip(b"\xef\xbb\xbf \r\n\t")
    other = next((words for start, words in _OTHER if text.startswith(start)), "")
    return (Container(other, video=False) if other else _raw(head)), None


def _raw(head: bytes) -> Container:
    """Streams without a container: those of H.264, HEVC and JPEG have no times."""
    if head.startswith(b"\xff\xd8\xff"):
        return Container("a stream of JPEG images", True, "JPEG", timed=False)
    if head.startswith(b"--") and b"image/jpeg" in head[:400].lower():
        return Container("a stream of JPEG images", True, "JPEG", timed=False)
    start = head.find(b"\x00\x00\x01")
    if not 0 <= start <= 1 or len(head) < start + 5:
        return Container()
    unit, following = head[start + 3], head[start + 4]
    if unit & 0x80 == 0 and unit & 0x1F in (1, 5, 6, 7, 9) and unit != 0x46:  # H.264, table 7-1
        return Container("a raw H.264 stream", True, "H.264", timed=False)
    if unit >> 1 in (32, 33, 34, 35, 39) and following & 0x07 == 1:  # HEVC (H.265), table 7-1
        return Container("a raw HEVC stream", True, "HEVC", timed=False)
    return Container()


_CODECS = {
    "AV1": "av01 V_AV1 AV01",
    "H.264": "avc1 avc2 avc3 avc4 V_MPEG4/ISO/AVC H264 h264 X264 x264 DAVC",
    "HEVC": "hvc1 hev1 dvh1 dvhe V_MPEGH/ISO/HEVC HEVC hevc H265",
    "VVC": "vvc1 vvi1 V_MPEGI/ISO/VVC",
    "encrypted": "encv",
    "ProRes": "apch apcn apcs apco ap4h ap4x V_PRORES",
    "VP8": "vp08 V_VP8 VP80",
    "VP9": "vp09 V_VP9 VP90",
    "MPEG-4": "mp4v V_MPEG4/ISO/ASP V_MPEG4/ISO/SP XVID xvid DIVX divx DX50 FMP4 MP4V",
    "Motion JPEG": "jpeg mjpa mjpb V_MJPEG MJPG mjpg",
}
_CODEC_OF = {tag: name for name, tags in _CODECS.items() for tag in tags.split()}


def _codec(tag: bytes) -> str:
    text = tag.rstrip(b"\0 ").decode("ascii", errors="replace")
    return _CODEC_OF.get(text, text if text.isprintable() else "")


_SINCE_1904_S = 2_082_844_800
"""From 1904, where MP4 counts from, to 1970."""
_SINCE_2001_S = 978_307_200
"""From 1970 to 2001, where Matroska counts from."""
_SINCE_1601_S = 11_644_473_600
"""From 1601, where Windows counts from, to 1970."""
_EARLIEST_S = 631_152_000
"""A file says nothing of its time when it says one before 1990: its clock was not set."""


def _created(seconds: float) -> int | None:
    return round(seconds * 1e9) if _EARLIEST_S < seconds < 2**32 else None


def _boxes(data: bytes, start: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Type, start and end of the content of every box of an MP4 file."""
    while start + 8 <= end:
        size, name = struct.unpack_from(">I4s", data, start)
        content = start + 8
        if size == 1:
            (size,) = struct.unpack_from(">Q", data, content)
            content += 8
        stop = end if size == 0 else start + size
        if stop < content or stop > end:
            return
        yield name, content, stop
        start = stop


def _read_mp4(file: BinaryIO, size: int, found: Container) -> Container:
    position, names, end, moov = 0, set[bytes](), 0, b""
    while position + 8 <= size:
        file.seek(position)
        length, name = struct.unpack(">I4s", file.read(8))
        header = 8
        if name not in _BOXES:
            break  # what cameras append of their own; the boxes before it are what counts
        if length == 1:
            (length,), header = struct.unpack(">Q", file.read(8)), 16
        end = size if length == 0 else position + max(length, header)
        names.add(name)
        if name == b"moov" and length <= _MAX_INDEX_BYTES and end <= size:
            moov = file.read(end - position - header)
        position = end
    indexed = b"moov" in names and bool(moov)
    whole = indexed and end <= size
    found = replace(found, whole=whole, indexed=indexed, announced_bytes=end)
    return _read_moov(moov, found) if moov else found


def _read_moov(moov: bytes, found: Container) -> Container:
    scale, fragments_s, tracks = 1, None, []
    for name, start, stop in _boxes(moov, 0, len(moov)):
        if name == b"mvhd":
            wide = moov[start] == 1
            created, _, scale = struct.unpack_from(">QQI" if wide else ">III", moov, start + 4)
            # FFmpeg's mov.c: some cameras count from 1970.
            seconds = created - _SINCE_1904_S if created >= _SINCE_1904_S else created
            found = replace(found, created_ns=_created(seconds))
        elif name == b"trak":
            tracks.append((start, stop))
        elif name == b"mvex":
            fragments_s = 0.0
            for child, a, _ in _boxes(moov, start, stop):
                if child == b"mehd":
                    long = struct.unpack_from(">Q" if moov[a] == 1 else ">I", moov, a + 4)[0]
                    fragments_s = long / max(scale, 1)
    for start, stop in tracks:
        handler, codec, length_s = _read_track(moov, start, stop, max(scale, 1))
        if handler == b"vide":
            length_s = fragments_s if fragments_s is not None else length_s
            return replace(found, video=True, codec=codec, length_s=length_s or None)
    return replace(found, video=False if tracks else None)


def _read_track(moov: bytes, start: int, stop: int, scale: int) -> tuple[bytes, str, float]:
    """Handler, codec and length in seconds of a track; edit lists say what of it is shown."""
    handler, codec, media_s, shown_s = b"", "", 0.0, None
    inside = {b"edts", b"mdia", b"minf", b"stbl"}
    waiting = [(start, stop)]
    while waiting:
        for name, a, b in _boxes(moov, *waiting.pop()):
            wide = a < b and moov[a] == 1
            if name in inside:
                waiting.append((a, b))
            elif name == b"hdlr" and not handler:
                handler = moov[a + 8 : a + 12]
            elif name == b"mdhd":
                ticks, long = struct.unpack_from(
                    ">IQ" if wide else ">II", moov, a + 4 + 8 * (1 + wide)
                )
                media_s = long / max(ticks, 1)
            elif name == b"stsd":
                codec = _codec(moov[a + 12 : a + 16])
            elif name == b"elst":
                (count,) = struct.unpack_from(">I", moov, a + 4)
                entry = struct.Struct(">QqI" if wide else ">IiI")
                edits = [entry.unpack_from(moov, a + 8 + k * entry.size) for k in range(count)]
                shown_s = sum(long for long, first, _ in edits if first >= 0) / scale
    return handler, codec, shown_s or media_s


def _number(file: BinaryIO, *, keep_mark: bool) -> int | None:
    """A variable-length integer (RFC 8794, section 4); None: size unknown, or the end."""
    first = file.read(1)
    if not first or not first[0]:
        return None
    length = 9 - first[0].bit_length()
    rest = file.read(length - 1)
    if len(rest) < length - 1:
        return None
    value = int.from_bytes(first + rest, "big")
    mark = 1 << (7 * length)
    if keep_mark:
        return value
    return None if value == 2 * mark - 1 else value - mark


_SEGMENT, _INFO, _TRACKS, _TRACK, _CLUSTER = 0x18538067, 0x1549A966, 0x1654AE6B, 0xAE, 0x1F43B675
_SCALE, _DURATION, _DATE, _TYPE, _CODEC_ID = 0x2AD7B1, 0x4489, 0x4461, 0x83, 0x86


def _matroska_values(file: BinaryIO, size: int) -> tuple[int | None, list[tuple[int, bytes]]]:
    """How long the file should be, and the entries on it and its tracks before the first image."""
    file.seek(0)
    values: list[tuple[int, bytes]] = []
    announced: int | None = None
    while file.tell() < size:
        name, length = _number(file, keep_mark=True), _number(file, keep_mark=False)
        if name == _SEGMENT:
            announced = None if length is None else file.tell() + length
        elif name is None or length is None or name == _CLUSTER:
            break
        elif name in (_SCALE, _DURATION, _DATE, _TYPE, _CODEC_ID):
            values.append((name, file.read(length)))
        elif name not in (_INFO, _TRACKS, _TRACK):
            file.seek(length, 1)
    return announced, values


def _read_matroska(file: BinaryIO, size: int, found: Container) -> Container:
    announced, values = _matroska_values(file, size)
    codecs, kinds, scale, length_s, created = [], [], 1e6, None, None
    for name, value in values:
        if name == _TYPE:
            kinds.append(int.from_bytes(value, "big"))
        elif name == _CODEC_ID:
            codecs.append(_codec(value))
        elif name == _SCALE:
            scale = int.from_bytes(value, "big")
        elif name == _DATE:
            created = _created(struct.unpack(">q", value)[0] / 1e9 + _SINCE_2001_S)
        elif name == _DURATION:
            length_s = struct.unpack(">f" if len(value) == 4 else ">d", value)[0]
    video = 1 in kinds if kinds else None
    codec = next((c for k, c in zip(kinds, codecs, strict=False) if k == 1), "")
    # The duration is that of the longest track, which may be sound.
    alone = length_s is not None and kinds == [1]
    return replace(
        found,
        video=video,
        codec=codec,
        length_s=length_s * scale / 1e9 if alone and length_s else None,
        announced_bytes=announced,
        whole=None if announced is None else announced <= size,
        created_ns=created,
    )


def _read_avi(file: BinaryIO, size: int, found: Container) -> Container:
    file.seek(0)
    head = file.read(_HEAD_BYTES)
    (riff,) = struct.unpack_from("<I", head, 4)
    kinds = []
    at = head.find(b"strh")
    while at >= 0:
        kind, tag = head[at + 8 : at + 12], head[at + 12 : at + 16]
        scale, rate, _, count = struct.unpack_from("<IIII", head, at + 28)
        kinds.append(kind)
        if kind == b"vids":
            found = replace(found, codec=_codec(tag), length_s=count * scale / max(rate, 1) or None)
        at = head.find(b"strh", at + 8)
    # A recorder that is killed leaves the size open: 0, or all ones as FFmpeg writes first.
    known = 12 < riff < 2**32 - 1
    return replace(
        found,
        video=b"vids" in kinds if kinds else None,
        announced_bytes=riff + 8 if known else None,
        whole=riff + 8 <= size if known else None,
    )


_FILE_PROPERTIES = bytes.fromhex("a1dcab8c47a9cf118ee400c00c205365")


def _read_asf(file: BinaryIO, size: int, found: Container) -> Container:
    file.seek(0)
    head = file.read(_HEAD_BYTES)
    at = head.find(_FILE_PROPERTIES)
    announced, created = struct.unpack_from("<QQ", head, at + 40) if at >= 0 else (0, 0)
    return replace(
        found,
        announced_bytes=announced or None,
        whole=announced <= size if announced else None,
        created_ns=_created(created / 1e7 - _SINCE_1601_S),
    )


def _read_flv(file: BinaryIO, size: int, found: Container) -> Container:
    """The last four bytes are the size of the tag before them."""
    file.seek(size - 4)
    (tag,) = struct.unpack(">I", file.read(4))
    file.seek(max(size - 4 - tag, 0))
    header = file.read(4)
    whole = tag + 13 <= size and header[0] in (8, 9, 18)
    return replace(found, whole=whole and int.from_bytes(header[1:4], "big") + 11 == tag)


def _read_ogg(file: BinaryIO, size: int, found: Container) -> Container:
    """The last page of a stream is marked as such."""
    file.seek(max(size - _TAIL_BYTES, 0))
    tail = file.read()
    at = tail.rfind(b"OggS")
    return replace(found, whole=bool(at >= 0 and tail[at + 5] & 4))
