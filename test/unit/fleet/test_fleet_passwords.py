"""Passwords of a fleet's cameras: in a file, a variable or the address, and shown nowhere."""

import json
import stat
import sys
from pathlib import Path

import pytest
from mjpeg_server import MjpegServer, grey_image

from geoorbit_ros.cli.camera import _password
from geoorbit_ros.cli.main import EXIT_BAD_INPUT, main
from geoorbit_ros.cli.process import _name
from geoorbit_ros.core.errors import InputFileError, ParameterError
from geoorbit_ros.fleet.fleet_io import load_fleet
from geoorbit_ros.fleet.plan import ProcessPlan, plan_fleet
from geoorbit_ros.fleet.supervisor import Supervisor

FLEET = """\
name: crossing
cameras:
  - id: north
    source: {source}
    image_size: [640, 480]
    calibration: north.csv
"""
ADDRESS = "rtsp://admin:SECRET99@192.0.2.1/s?token=SECRET98&channel=1"
SHOWN = "rtsp://admin:***@192.0.2.1/s?token=***&channel=1"


def write(folder: Path, source: str, more: str = "") -> Path:
    file = folder / "fleet.yaml"
    file.write_text(FLEET.format(source=source) + more)
    (folder / "north.csv").touch()
    return file


def plan(file: Path) -> ProcessPlan:
    fleet, _ = load_fleet(file)
    (found,) = plan_fleet(fleet, file.parent, file.parent / "out")
    return found


def camera_parameters(found: ProcessPlan) -> dict[str, object]:
    return dict(next(n.parameters for n in found.nodes if n.executable == "camera"))


def test_a_dry_run_shows_no_password(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = write(tmp_path, ADDRESS)
    assert main(["up", str(file), "--dry-run", "--out", str(tmp_path / "out")]) == 0
    shown = "".join(capsys.readouterr().out.split())
    assert f"source={SHOWN}" in shown
    assert "SECRET" not in shown


def test_neither_plan_file_nor_arguments_of_a_process_have_a_password(tmp_path: Path) -> None:
    """The process itself gets it in its environment, which others can't read."""
    found, out = plan(write(tmp_path, ADDRESS)), tmp_path / "out"
    program = "import json,os,sys; json.dump([sys.argv, dict(os.environ)], open(sys.argv[1], 'w'))"
    report = tmp_path / "report.json"

    def command(_plan: Path, _descriptor: int) -> list[str]:
        return [sys.executable, "-c", program, str(report)]

    supervisor = Supervisor([found], out, command=command)
    supervisor.step(0.0)
    process = supervisor.members["north"].process
    assert process is not None
    assert process.wait(60) == 0
    supervisor.stop()
    arguments, environment = json.loads(report.read_text())
    assert "SECRET" not in " ".join(arguments)
    text = (out / "plans" / "north.json").read_text()
    assert "SECRET" not in text
    assert SHOWN in text
    assert stat.S_IMODE((out / "plans" / "north.json").stat().st_mode) == 0o600
    secrets = json.loads(environment["GEOORBIT_SECRETS"])
    again = ProcessPlan.from_json(text, "here", secrets)
    assert camera_parameters(again)["source"] == ADDRESS
    assert again.secrets() == found.secrets() == {SHOWN: ADDRESS}


def test_a_plan_without_secrets_gives_its_process_none(tmp_path: Path) -> None:
    assert plan(write(tmp_path, "rtsp://192.0.2.1/s?channel=1")).secrets() == {}


def test_a_password_in_a_file_stays_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    secret = tmp_path / "north.password"
    secret.write_text("SE[CRET/#\n")
    file = write(tmp_path, "rtsp://admin@192.0.2.1/s", "    password_file: north.password\n")
    found = plan(file)
    parameters = camera_parameters(found)
    assert parameters["password_file"] == str(secret)
    assert found.secrets() == {}
    camera = load_fleet(file)[0].cameras[0]
    assert camera.address(tmp_path) == "rtsp://admin:SE%5BCRET%2F%23@192.0.2.1/s"
    for mode, warned in ((0o644, True), (0o600, False)):
        secret.chmod(mode)
        assert main(["up", str(file), "--dry-run"]) == 0
        assert ("other users can read" in capsys.readouterr().err) == warned


def test_a_password_in_a_variable_is_taken_from_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = write(tmp_path, "rtsp://admin@192.0.2.1/s", "    password_variable: NORTH_PASSWORD\n")
    monkeypatch.delenv("NORTH_PASSWORD", raising=False)
    with pytest.raises(ParameterError, match="camera north, password: found no environment"):
        plan(file)
    monkeypatch.setenv("NORTH_PASSWORD", "SECRET@99")
    found = plan(file)
    assert camera_parameters(found)["password_variable"] == "NORTH_PASSWORD"
    assert "SECRET" not in found.to_json()
    camera = load_fleet(file)[0].cameras[0]
    assert camera.address(tmp_path) == "rtsp://admin:SECRET%4099@192.0.2.1/s"


WRONG = [
    # source, further lines, words of the sentence
    ("'rtsp://admin:SE[CRET@192.0.2.1/s'", "", ["line 4", "'[' in the password", "%5B", "north"]),
    ("'rtsp://admin:SE/CRET@192.0.2.1/s'", "", ["line 4", "'/' in the password", "%2F", "north"]),
    ("'rtsp://admin:SE#CRET@192.0.2.1/s'", "", ["line 4", "'#' in the password", "%23", "north"]),
    ("onvif://admin:SECRET@192.0.2.1", "", ["'onvif://'", "rtsp"]),
    ("rtsp://192.0.2.1/s", "    password_file: x\n", ["a user name alone"]),
    ("rtsp://admin:SECRET@192.0.2.1/s", "    password_file: x\n", ["a user name alone"]),
    ("film.mp4", "    password_file: x\n", ["'film.mp4'", "an address"]),
    (
        "rtsp://admin@192.0.2.1/s",
        "    password_file: x\n    password_variable: X\n",
        ["password_file and password_variable", "one of them"],
    ),
]


@pytest.mark.parametrize(("source", "more", "words"), WRONG)
def test_a_wrong_address_is_named_with_its_camera_and_without_its_password(
    tmp_path: Path, source: str, more: str, words: list[str]
) -> None:
    with pytest.raises(InputFileError) as caught:
        load_fleet(write(tmp_path, source, more))
    text = str(caught.value)
    assert [word for word in words if word not in text] == []
    assert "SECRET" not in text
    assert "CRET" not in text


@pytest.mark.parametrize("source", ["admin:SECRET@192.0.2.1/s", "rtsp:/admin:SECRET@192.0.2.1/s"])
def test_a_source_that_is_not_there_shows_no_password(
    tmp_path: Path, source: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["up", str(write(tmp_path, f"'{source}'")), "--dry-run"]) == EXIT_BAD_INPUT
    error = capsys.readouterr().err
    assert "SECRET" not in error
    assert "north" in error


def test_a_camera_is_not_called_by_its_password() -> None:
    assert _name("rtsp://admin:SECRET@192.0.2.1") == "192.0.2.1"
    assert _name("rtsp://admin:SE/CRET@cam/s") == "cam"
    assert _name("scene:on_ramp_merge?seed=2") == "on_ramp_merge"


def test_the_name_of_a_file_with_colons_is_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("2024-05-24T08:00:00.mp4").touch()
    assert _name("2024-05-24T08:00:00.mp4") == "2024-05-24T08:00:00"


class Job:
    camera_id = "north"


def test_camera_add_puts_a_password_into_a_file_of_its_own(tmp_path: Path) -> None:
    job, fleet = Job(), tmp_path / "fleet.yaml"
    entry = _password(ADDRESS.replace("99", "%2F99"), None, job, fleet)  # type: ignore[arg-type]
    assert entry == {"password_file": "north.password"}
    file = tmp_path / "north.password"
    assert file.read_text() == "SECRET/99\nSECRET98\n"
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    more = "    password_file: north.password\n"
    camera = load_fleet(write(tmp_path, SHOWN, more))[0].cameras[0]
    assert camera.address(tmp_path) == ADDRESS.replace("99", "%2F99")
    assert _password("rtsp://c/1", None, job, fleet) == {}  # type: ignore[arg-type]


@pytest.mark.parametrize("password", ["S3cret", "a/b#c[d]?e@f%g:h i", "ä€^{}|\"<>\\'`"])
@pytest.mark.parametrize("way", ["file", "codes"])
def test_any_password_opens_a_camera(
    tmp_path: Path, password: str, way: str, capsys: pytest.CaptureFixture[str]
) -> None:
    from urllib.parse import quote

    secret, plugin = tmp_path / "password", tmp_path / "nothing.py"
    secret.write_text(password)
    plugin.write_text(
        "import numpy as np\nfrom geoorbit_ros.core.tables import DETECTION_DTYPE\n"
        "class Nothing:\n    name = 'nothing'\n    def warm_up(self, images): pass\n"
        "    def detect(self, stamp_ns, image): return np.zeros(0, DETECTION_DTYPE)\n"
    )
    with MjpegServer([grey_image(90)] * 5, [grey_image(90)] * 5) as server:
        server.credentials = f"admin:{password}"
        user = "admin" if way == "file" else f"admin:{quote(password, safe='')}"
        words = ["detect", server.address.replace("http://", f"http://{user}@")]
        words += ["--out", str(tmp_path / "d.txt"), "--duration", "0.1"]
        words += ["--model", f"{plugin}:Nothing"]
        words += ["--password-file", str(secret)] if way == "file" else []
        assert main(words) == 0
    shown = capsys.readouterr()
    assert password not in shown.out + shown.err
    assert quote(password, safe="") not in shown.out + shown.err
