"""Passwords in addresses: never shown, never lost, and refused in a sentence that shows none."""

from pathlib import Path
from urllib.parse import quote

import pytest
from hypothesis import given
from hypothesis import strategies as st

from geoorbit_ros.core.addresses import (
    check_address,
    is_address,
    masked,
    masked_text,
    read_password,
    secrets_of,
    with_password,
)
from geoorbit_ros.core.errors import ParameterError

SHOWN = [
    # address, as it is shown
    ("rtsp://192.0.2.1:554/Streaming/Channels/101", None),
    ("rtsp://admin@192.0.2.1/s", None),
    ("rtsp://admin:@192.0.2.1/s", None),
    ("rtsp://[2001:db8::1]:554/s", None),
    ("rtsp://192.0.2.1:554/live@main", None),
    ("udp://@239.0.0.1:1234", None),
    ("http://c/v?action=stream&channel=1;subtype=0", None),
    ("north road: a film.mp4", None),
    ("scene:on_ramp_merge?seed=1", None),
    ("rtsp://admin:SECRET@192.0.2.1/s", "rtsp://admin:***@192.0.2.1/s"),
    ("rtsp://admin:SE:CRET@192.0.2.1/s", "rtsp://admin:***@192.0.2.1/s"),
    ("rtsp://:SECRET@192.0.2.1/s", "rtsp://:***@192.0.2.1/s"),
    ("RTSP://admin:SECRET@h/s", "RTSP://admin:***@h/s"),
    ("rtsp://admin:SE[CRET@192.0.2.1/s", "rtsp://admin:***@192.0.2.1/s"),
    ("rtsp://admin:SE/CRET@192.0.2.1/s", "rtsp://admin:***@192.0.2.1/s"),
    ("rtsp://admin:SE#CRET@192.0.2.1/s", "rtsp://admin:***@192.0.2.1/s"),
    ("rtsp://admin:SE?CRET@192.0.2.1/s", "rtsp://admin:***@192.0.2.1/s"),
    ("rtsp://admin:SE@CRET@192.0.2.1/s", "rtsp://admin:***@192.0.2.1/s"),
    ("rtsp://admin:SE@C/RET@192.0.2.1/s", "rtsp://admin:***@192.0.2.1/s"),
    ("rtsp://admin:12/SECRET@192.0.2.1/s", "rtsp://admin:***@192.0.2.1/s"),
    ("rtsp://admin:SEC RET@192.0.2.1/s", "rtsp://admin:***@192.0.2.1/s"),
    ("rtsp://admin:SECRET@[fe80::1]:554/s", "rtsp://admin:***@[fe80::1]:554/s"),
    ("rtsp://admin:SECRET@192.0.2.1:554/live@main", "rtsp://admin:***@192.0.2.1:554/live@main"),
    ("rtsp://us/er:SECRET@192.0.2.1/s", "rtsp://***@192.0.2.1/s"),
    ("rtsp://admin:SE#CRET", "rtsp://admin:***"),
    ("rtsp:/admin:SECRET@192.0.2.1/s", "rtsp:/admin:***@192.0.2.1/s"),
    ("onvif://admin:SECRET@192.0.2.1", "onvif://admin:***@192.0.2.1"),
    ("admin:SECRET@192.0.2.1/s", "***@192.0.2.1/s"),
    ("http://c/v?user=admin&pwd=SECRET&channel=1", "http://c/v?user=admin&pwd=***&channel=1"),
    ("http://c/v?channel=1&SECRET", "http://c/v?channel=1&***"),
    ("http://c/v?token=SECRET#SECRET", "http://c/v?token=***#***"),
    ("srt://c:9000?streamid=SECRET&passphrase=SECRET", "srt://c:9000?streamid=***&passphrase=***"),
    (
        "rtsp://c:554/user=admin_password=SECRET_channel=1_stream=0.sdp",
        "rtsp://c:554/user=admin_password=***_channel=1_stream=0.sdp",
    ),
    (
        "rtsp://c/user=admin&password=SECRET&channel=1&stream=0.sdp?",
        "rtsp://c/user=admin&password=***&channel=1&stream=0.sdp?",
    ),
]


@pytest.mark.parametrize(("address", "shown"), SHOWN)
def test_an_address_is_shown_without_its_secrets(address: str, shown: str | None) -> None:
    assert masked(address) == (shown or address)
    assert masked(masked(address)) == masked(address), "what is masked stays as it is"


def test_addresses_within_a_text_are_masked() -> None:
    text = "no answer from rtsp://admin:SECRET@c/1, http://c/?pw=SECRET: again"
    assert masked_text(text) == "no answer from rtsp://admin:***@c/1, http://c/?pw=*** again"


@pytest.mark.parametrize(
    "text",
    [
        "gst:rtspsrc location=rtsp://u:SECRET@192.0.2.4/s user-pw=SECRET ! decodebin",
        "no x/gst:rtspsrc location=rtsp:/u:SECRET@192.0.2.4/s user_password=SECRET ! decodebin",
        "souphttpsrc token=SECRET",
    ],
)
def test_secrets_of_a_pipeline_and_of_a_path_made_of_it_are_masked(text: str) -> None:
    assert masked_text(text) == text.replace("SECRET", "***")


@pytest.mark.parametrize("text", ["C:/films/a.mp4: no such file", "expected key=value", "a:b@c"])
def test_a_text_without_secrets_stays_as_it_is(text: str) -> None:
    assert masked_text(text) == text


passwords = st.text("ABCXYZ0[]/?#@%:&;=+ \\\"'<>^|", min_size=2)


@given(passwords)
def test_no_letter_of_any_password_is_shown(password: str) -> None:
    address = f"rtsp://admin:{password}@192.0.2.1:554/live"
    shown = masked(address)
    assert not any(letter.isupper() for letter in shown.removeprefix("rtsp://"))
    try:
        check_address(address)
    except ParameterError as error:
        assert not any(letter.isupper() for letter in str(error.place))
        assert len(str(error.found)) < 40
    else:
        assert shown == "rtsp://admin:***@192.0.2.1:554/live"


@given(st.text(min_size=1).filter(lambda text: len(text.splitlines()) == 1 and text.strip()))
def test_any_password_works_when_it_is_written_as_codes(password: str) -> None:
    try:
        password.encode()
    except UnicodeEncodeError:
        return
    (password,) = password.splitlines()
    address = f"rtsp://admin:{quote(password, safe='')}@192.0.2.1:554/live"
    check_address(address)
    assert secrets_of(address) == [password]
    assert with_password("rtsp://admin@192.0.2.1:554/live", password, "here") == address
    assert with_password(masked(address), password, "here") == address


WRONG = [
    # address, what is said to be found, what is expected in its place
    ("rtsp://admin:SE[CRET@192.0.2.1/s", "'[' in the password", "%5B"),
    ("rtsp://admin:SE]CRET@192.0.2.1/s", "']' in the password", "%5D"),
    ("rtsp://admin:SE/CRET@192.0.2.1/s", "'/' in the password", "%2F"),
    ("rtsp://admin:SE?CRET@192.0.2.1/s", "'?' in the password", "%3F"),
    ("rtsp://admin:SE#CRET@192.0.2.1/s", "'#' in the password", "%23"),
    ("rtsp://admin:SE@CRET@192.0.2.1/s", "'@' in the password", "%40"),
    ("rtsp://admin:SE%CRET@192.0.2.1/s", "'%' in the password", "%25"),
    ("rtsp://admin:SE CRET@192.0.2.1/s", "' ' in the password", "%20"),
    ("rtsp://admin:12/34@cam/s", "'/' in the password", "%2F"),
    ("rtsp://ad/min:SECRET@192.0.2.1/s", "'/' in the user name", "%2F"),
    ("http://c/v?password=SE#CRET", "'#'", "%23"),
    ("rtsp://admin:SECRET", "no host", "HOST:PORT"),
    ("rtsp://", "no host", "HOST:PORT"),
    ("onvif://admin:SECRET@192.0.2.1", "'onvif://'", "rtsp, rtsps, http"),
    ("admin:SECRET@192.0.2.1/s", "no scheme", "rtsp, rtsps, http"),
]


@pytest.mark.parametrize(("address", "found", "expected"), WRONG)
def test_a_wrong_address_is_one_sentence_without_the_password(
    address: str, found: str, expected: str
) -> None:
    with pytest.raises(ParameterError) as caught:
        check_address(address)
    text = str(caught.value)
    assert found in text
    assert expected in text
    assert "\n" not in text
    assert not any(part in text for part in ("SECRET", "CRET@", "SE[", "SE/", "12/34", ":SE"))


RIGHT = [
    "rtsp://admin:S3cret99@192.0.2.1/s",
    "rtsp://admin:a:b!$&'()*+,;=-._~@192.0.2.1/s",
    'rtsp://admin:^{}|"<>\\`ä@192.0.2.1/s',
    "rtsp://admin:%5B%2F%23@192.0.2.1:554/live@main",
    "http://192.0.2.1:8080/videostream.cgi?user=admin&pwd=a/b",
    "rtsp://camera/1",
    "rtmp://localhost/live/north",
]


@pytest.mark.parametrize("address", RIGHT)
def test_a_right_address_is_taken(address: str) -> None:
    check_address(address)
    assert is_address(address)


@pytest.mark.parametrize(
    ("address", "password", "full"),
    [
        ("rtsp://admin@c/1", "a/b", "rtsp://admin:a%2Fb@c/1"),
        ("rtsp://admin:***@c/1", "a", "rtsp://admin:a@c/1"),
        ("http://c/?u=x&password=***", "a&b", "http://c/?u=x&password=a%26b"),
        ("http://u:***@c/?token=***", "a\nb", "http://u:a@c/?token=b"),
    ],
)
def test_a_password_is_put_in_its_place(address: str, password: str, full: str) -> None:
    assert with_password(address, password, "here") == full


@pytest.mark.parametrize(
    ("address", "password"),
    [
        ("rtsp://c/1", "a"),
        ("rtsp://admin:b@c/1", "a"),
        ("rtsp://admin@c/1", "a\nb"),
        ("http://u:***@c/?token=***", "a"),
        ("north.mp4", "a"),
    ],
)
def test_a_password_without_a_place_is_refused(address: str, password: str) -> None:
    with pytest.raises(ParameterError, match="a user name alone") as caught:
        with_password(address, password, "here")
    assert ":b@" not in str(caught.value)


def test_a_password_file_is_read_as_people_write_it(tmp_path: Path) -> None:
    file = tmp_path / "north.password"
    for content in (b"a b#", b"a b#\n", b"\xef\xbb\xbfa b#\r\n", b"a b#\n\n"):
        file.write_bytes(content)
        assert read_password(file, "here") == "a b#"
    for content, words in ((b"", "nothing in it"), (b"\n", "nothing in it"), (b"\xff", "UTF-8")):
        file.write_bytes(content)
        with pytest.raises(ParameterError, match=words):
            read_password(file, "here")
    with pytest.raises(ParameterError, match="No such file"):
        read_password(tmp_path / "absent", "here")
