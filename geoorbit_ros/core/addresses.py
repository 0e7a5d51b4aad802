"""Addresses of streams, and the passwords in them, which no message may show.

`masked` is the one function that hides them. A password is what stands between the first colon and
the `@` before the host (RFC 3986, section 3.2.1), or a value after `?` or in the path, such as
`password=…`. Of an address that is not as it should be, too much is hidden rather than too little.
"""

from __future__ import annotations

import re
from pathlib import Path
from urllib.parse import quote, unquote

from geoorbit_ros.core.errors import ParameterError

MASK = "***"
"""Stands where a secret was."""
SCHEMES = (
    *("rtsp", "rtsps", "http", "https", "rtmp", "rtmps"),
    *("rtp", "udp", "srt", "tcp", "mms", "mmsh"),
)
"""Of streams that FFmpeg can open."""
_ADDRESS = re.compile(r"\s*([A-Za-z][A-Za-z0-9+.\-]*):/{1,2}(.*)", re.DOTALL)
_LOOSE = re.compile(r"[^\s/]*:[^\s]*@")
"""User and password before a host, where the scheme is missing."""
_IN_TEXT = re.compile(r"[A-Za-z][A-Za-z0-9+.\-]+:/{1,2}\S+")
"""With one slash, too: that is what a path made of an address has."""
_HOST = re.compile(r"(\[[0-9A-Fa-f:.%]+\]|localhost|[\w\-]+(\.[\w\-]+)+\.?)(:\d{1,5})?")
"""A host that is plainly one, and a port."""
_PLAIN_HOST = re.compile(r"(\[[0-9A-Fa-f:.%]+\]|[\w.\-~%!$&'()*+,;=]*)(:\d{0,5})?")
"""What may stand where the host is (RFC 3986, section 3.2.2)."""
_SHOWN = (
    "action camera cam channel ch codec compression fps height id login profile proto quality "
    "resolution stream streamtype stream_type subtype transport transportmode type unicast user "
    "username usr videocodec width"
)
"""What may be read after `?`: what tells one stream of a recorder from the other."""
_SHOWN_KEYS = frozenset(_SHOWN.split())
_SECRET_KEY = r"(?:pass(?:word|wd)?|pwd|psw|token|key|secret|auth|sig(?:nature)?)"
_ITEM_IN_TEXT = re.compile(
    r"(?i)\b((?:[\w\-]*[_\-])?(?:pass(?:word|wd|phrase)?|pwd|psw|pw|token|secret)=)([^\s&;]+)"
)
"""As in the GStreamer pipeline `rtspsrc location=… user-pw=…`."""
_IN_PATH = re.compile(rf"(?i)({_SECRET_KEY}=)(.*?)(?=_channel=|_stream=|[&/;?]|$)")
"""As in `rtsp://camera/user=admin_password=…_channel=1_stream=0.sdp`."""


def is_address(text: str) -> bool:
    """Whether a text is an address (`scheme://…`), and not the name of a local file."""
    found = re.match(r"([A-Za-z][A-Za-z0-9+.\-]*)://", text)
    return found is not None and found[1].lower() != "file"


def masked(address: str) -> str:
    """An address without its secrets: `rtsp://admin:***@192.0.2.1/s?channel=1&token=***`."""
    found = _ADDRESS.fullmatch(address)
    if found is None:
        loose = _LOOSE.match(address)
        return f"{MASK}@{address[loose.end() :]}" if loose else address
    start, rest = address[: found.start(2)].lstrip(), found[2]
    user, tail = _parted(rest)
    tail, hash_sign, _ = tail.partition("#")
    path, question, query = tail.partition("?")
    shown = start + user + _IN_PATH.sub(rf"\1{MASK}", path)
    if question:
        shown += "?" + "".join(map(_masked_item, re.split("([&;])", query)))
    return shown + (f"#{MASK}" if hash_sign else "")


def masked_text(text: str) -> str:
    """A text in which every address and every `password=…` is masked."""
    without = _IN_TEXT.sub(lambda found: masked(found[0]), text)
    return _ITEM_IN_TEXT.sub(rf"\1{MASK}", without)


def _parted(rest: str) -> tuple[str, str]:
    """User and mask up to the `@`, and what follows; of what stands after `scheme://`."""
    before, after = _user_and_host(rest)
    if before is None:
        authority = re.split("[/?#]", rest, maxsplit=1)[0]
        host, colon, _ = authority.partition(":")
        if not colon or _PLAIN_HOST.fullmatch(authority):
            return "", rest
        return "", f"{host}:{MASK}"  # something after a colon that is no port
    user, colon, password = before.partition(":")
    if not re.fullmatch(r"[\w.~%+\-]*", user):
        return f"{MASK}@", after
    return (f"{user}:{MASK}@" if colon and password else f"{before}@"), after


def _user_and_host(rest: str) -> tuple[str | None, str]:
    """What stands before the host's `@`, None: nothing; and what follows.

    Where a reserved character in a password makes it doubtful which `@` is meant, it is the last.
    """
    authority = re.split("[/?#]", rest, maxsplit=1)[0]
    before, at, host = authority.rpartition("@")
    if _HOST.fullmatch(host) or "@" not in rest[len(authority) :]:
        return (before if at else None), rest[len(before) + len(at) :]
    before, _, after = rest.rpartition("@")
    return before, after


def _masked_item(item: str) -> str:
    key, equals, value = item.partition("=")
    if item in ("", "&", ";") or (equals and (not value or key.lower() in _SHOWN_KEYS)):
        return item
    return f"{key}={MASK}" if equals else MASK


def secrets_of(address: str) -> list[str]:
    """What `masked` hides in an address, in order and without codes such as %23."""
    pattern = re.escape(masked(address)).replace(re.escape(MASK), "(.*)")
    found = re.fullmatch(pattern, address.lstrip(), re.DOTALL)
    return [unquote(group) for group in found.groups()] if found else []


def check_address(address: str, place: str = "") -> None:
    """Refuse an address in which a reserved character stands in the password or user name.

    Args:
        address: As the user wrote it.
        place: Where it was written; default: the address, masked.

    Raises:
        ParameterError: Naming the character and how it is written, and not the password.
    """
    place = place or masked(address)
    scheme, colon, rest = address.strip().partition("://")
    if not colon or scheme.lower() not in SCHEMES:
        found = f"'{scheme}://'" if colon else "no scheme"
        raise ParameterError(place, found, f"an address with {', '.join(SCHEMES)}")
    user, tail = _user_and_host(rest)
    if user is not None:
        _check_user(user, place)
    host = re.split("[/?#]", tail, maxsplit=1)[0]
    if "#" in rest:
        raise ParameterError(place, "'#'", "an address without it; in a password it is written %23")
    if not host or not _PLAIN_HOST.fullmatch(host):
        expected = "HOST or HOST:PORT, as in rtsp://USER:PASSWORD@HOST:554/PATH"
        raise ParameterError(place, "no host, or a port that is no number", expected)


def _check_user(user: str, place: str) -> None:
    """Refuse what RFC 3986, section 2.2 and 3.2.1, reserves for other places of an address."""
    for wrong in re.finditer(r"[/?#\[\]@\s]|%(?![0-9A-Fa-f]{2})", user):
        part = "password" if ":" in user[: wrong.start()] else "user name"
        code = quote(wrong[0], safe="")
        expected = f"{code} in its place: reserved characters of a {part} are written as codes"
        raise ParameterError(place, f"'{wrong[0]}' in the {part}", expected)


def with_password(address: str, password: str, place: str) -> str:
    """The address with a password, in whose place it has `***`, or only a user name.

    Args:
        address: `rtsp://admin@camera/1`, or `http://camera/?user=admin&password=***`.
        password: As the camera knows it; of several places one per line.
        place: What the user gave it in.

    Raises:
        ParameterError: The address has no place for it, or has a password.
    """
    values = [quote(line, safe="") for line in password.splitlines()] or [""]
    parts = address.split(MASK)
    if len(parts) > 1 and len(parts) - 1 == len(values):
        pairs = zip(parts, [*values, ""], strict=True)
        return "".join(text + value for text, value in pairs)
    scheme, _, rest = address.partition("://")
    user, at, host = rest.rpartition("@")
    if len(values) != 1 or not at or ":" in user or "/" in user or "?" in user:
        found = f"{len(values)} password{'' if len(values) == 1 else 's'} for {masked(address)}"
        expected = f"an address with a user name alone (rtsp://USER@HOST/…), or {MASK} for each"
        raise ParameterError(place, found, expected)
    return f"{scheme}://{user}:{values[0]}@{host}"


def read_password(file: Path, place: str) -> str:
    """The password in a file: its lines without blank ones at the end.

    Raises:
        ParameterError: It can't be read, or is empty.
    """
    try:
        text = file.read_text(encoding="utf-8-sig").rstrip("\r\n")
    except (OSError, UnicodeDecodeError) as error:
        reason = (isinstance(error, OSError) and error.strerror) or "no text in UTF-8"
        raise ParameterError(place, f"{file}: {reason}", "a file with a password") from None
    if not text.strip():
        raise ParameterError(place, f"{file}: nothing in it", "a file with a password")
    return text
