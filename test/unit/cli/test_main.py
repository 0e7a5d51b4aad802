"""The command's frame: quick help, version, exit codes."""

from __future__ import annotations

import inspect
import re
import subprocess
import sys

import pytest

from geoorbit_ros import __version__
from geoorbit_ros.cli import app as commands
from geoorbit_ros.cli import main as cli
from geoorbit_ros.cli.console import as_typed
from geoorbit_ros.cli.lanes import lanes
from geoorbit_ros.cli.report import report
from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.fleet.fleet_file import NODES
from geoorbit_ros.lanes.mapping.mapper import DEFAULT_UPDATE_PERIOD_S
from geoorbit_ros.parameters import load_schema

COMMANDS = (
    *("demo", "lanes", "process", "replay", "detect", "track", "score", "report", "train"),
    *("evaluate", "export", "up", "status", "view", "scene", "camera", "bag", "db", "map", "twin"),
    *("federation", "fleet"),
)


def python(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"geoorbit {__version__}\n"


def test_messages_name_the_command_as_it_was_called(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("GEOORBIT_COMMAND", raising=False)
    assert as_typed("up fleet.yaml") == "geoorbit up fleet.yaml"
    monkeypatch.setenv("GEOORBIT_COMMAND", "./dev run")
    assert as_typed("up fleet.yaml") == "./dev run up fleet.yaml"


def test_help_lists_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--help"]) == 0
    text = capsys.readouterr().out
    for command in COMMANDS:
        assert re.search(rf"\b{command}\b", text)


def leaf_commands() -> list[tuple[str, ...]]:
    """Every command that does something, as the words that call it."""
    words: list[tuple[str, ...]] = [(str(c.name),) for c in commands.app.registered_commands]
    for group in commands.app.registered_groups:
        assert group.name
        assert group.typer_instance
        words += [(group.name, str(c.name)) for c in group.typer_instance.registered_commands]
    return words


@pytest.mark.parametrize("words", leaf_commands(), ids=" ".join)
def test_every_command_teaches_with_an_example(
    words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main([*words, "--help"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "Example" in text
    assert f"geoorbit {' '.join(words)}" in text
    if "new or empty" in text:
        assert "--force" in text or "--replace" in text


def test_help_loads_nothing_heavy() -> None:
    heavy = "{'numpy', 'scipy', 'rclpy', 'pyproj', 'cv2', 'libsumo', 'pyarrow', 'sklearn', 'yaml'}"
    done = python(f"import sys, geoorbit_ros.cli.app; print(sorted({heavy} & set(sys.modules)))")
    assert done.stdout.strip() == "[]", done.stderr


def test_the_default_update_period_is_the_mappers() -> None:
    for command in (lanes, report):
        default = inspect.signature(command).parameters["update_period_s"].default
        assert default == DEFAULT_UPDATE_PERIOD_S


def test_a_known_error_is_one_sentence_and_exit_code_2(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(**_: object) -> None:
        raise InputFileError("t.csv, line 3, column 'w'", "'wide'", "a number")

    monkeypatch.setattr(commands, "app", fail)
    assert cli.main([]) == 2
    expected = "geoorbit: t.csv, line 3, column 'w': found 'wide', expected a number\n"
    assert capsys.readouterr().err == expected


def test_a_defect_keeps_its_traceback() -> None:
    done = python(
        "from geoorbit_ros.cli import main as m\n"
        "import geoorbit_ros.lanes.geojson as g\n"
        "def broken(*_): raise ZeroDivisionError('defect')\n"
        "g.read_lane_file = broken\n"
        "raise SystemExit(m.main(['score', 'a', 'b']))"
    )
    assert done.returncode == 1
    assert "Traceback" in done.stderr
    assert "ZeroDivisionError: defect" in done.stderr


def test_ctrl_c_ends_quietly_with_130() -> None:
    done = python(
        "from geoorbit_ros.cli import main as m\n"
        "import geoorbit_ros.lanes.geojson as g\n"
        "def interrupted(*_): raise KeyboardInterrupt\n"
        "g.read_lane_file = interrupted\n"
        "raise SystemExit(m.main(['score', 'a', 'b']))"
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


def test_unknown_options_are_usage_errors(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["score", "--colour"]) == 2
    assert "--colour" in capsys.readouterr().err


def test_the_parameters_of_a_node_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["fleet", "parameters", "tracker"]) == 0
    said = capsys.readouterr().out
    for spec in load_schema("tracker"):
        assert spec.name in said


def test_the_parameters_of_every_node_of_a_fleet_are_listed(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cli.main(["fleet", "parameters"]) == 0
    said = capsys.readouterr().out
    for node in NODES:
        assert node in said


def test_parameters_of_an_unknown_node_are_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["fleet", "parameters", "trackers"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("geoorbit: node: found 'trackers', expected one of bag_player, ")
    assert said.count("\n") == 1
