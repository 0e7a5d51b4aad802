"""`geoorbit federation`: keys that the roster reads, and an epsilon."""

from pathlib import Path

import pytest

from geoorbit_ros.cli.main import main
from geoorbit_ros.federated.keys import Roster, Signer, read_private_key


def test_a_key_and_its_line_on_the_roster(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "north.key"
    assert main(["federation", "key", str(path)]) == 0
    roster = tmp_path / "roster.txt"
    roster.write_text(capsys.readouterr().out)
    (number,) = Roster.read(roster)
    member = Roster.read(roster).get(number)
    assert member is not None
    assert member.camera_id == "north"
    assert member.public == Signer(read_private_key(path), "any").public
    before = path.read_bytes()
    assert main(["federation", "key", str(path)]) == 2
    assert "north.key" in capsys.readouterr().err
    assert path.read_bytes() == before


def test_epsilon_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["federation", "epsilon", "1", "1"]) == 0
    assert capsys.readouterr().out == "epsilon = 4.38 at delta = 1e-05\n"
    assert main(["federation", "epsilon", "0", "1"]) == 2
    assert "noise" in capsys.readouterr().err
