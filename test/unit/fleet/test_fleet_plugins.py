"""Plug-ins that a fleet file names: found beside it, and loaded before anything starts."""

from pathlib import Path

import pytest

from geoorbit_ros.cli.main import main
from geoorbit_ros.fleet.fleet_io import load_fleet
from geoorbit_ros.fleet.plan import chosen_plugins, plan_fleet

FLEET = """
name: crossing
cameras:
  - id: north
    source: north.mp4
    calibration: north.csv
    model: red.py:Red
    parameters:
      tracker: {tracker: large.py:Large}
      lane_geometry: {estimator: sub/wide.py:Wide}
      meta_client: {estimator: sub/wide.py:Wide}
federated_server: {parameters: {strategy: cautious.py:Cautious}}
"""
FILES = {
    "red.py": "class Red:\n    name = 'red'\n    def warm_up(self, images): ...\n"
    "    def detect(self, stamp_ns, image): ...\n",
    "large.py": "from geoorbit_ros.tracking.tracker import Tracker\nclass Large(Tracker): ...\n",
    "sub/wide.py": "class Wide:\n    def add(self, stamp_ns, rows): ...\n"
    "    def lanes(self, parameters): ...\n",
    "cautious.py": "from geoorbit_ros.federated.strategies.strategy import Strategy\n"
    "class Cautious(Strategy): ...\n",
}


@pytest.fixture
def fleet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A fleet file with plug-ins beside it; the current folder is another one."""
    folder, elsewhere = tmp_path / "fleet", tmp_path / "elsewhere"
    (folder / "sub").mkdir(parents=True)
    elsewhere.mkdir()
    for name, text in {**FILES, "fleet.yaml": FLEET, "north.mp4": "", "north.csv": ""}.items():
        (folder / name).write_text(text, encoding="utf-8")
    monkeypatch.chdir(elsewhere)
    return folder / "fleet.yaml"


def test_every_plugin_is_found_beside_the_fleet_file(fleet: Path) -> None:
    content, _ = load_fleet(fleet)
    plans = plan_fleet(content, fleet.parent, fleet.parent / "out")
    beside = [
        (kind, str(fleet.parent / name))
        for kind, name in (
            ("strategy", "cautious.py:Cautious"),
            ("estimator", "sub/wide.py:Wide"),
            ("estimator", "sub/wide.py:Wide"),
            ("tracker", "large.py:Large"),
            ("detector", "red.py:Red"),
        )
    ]
    assert sorted((kind, name) for _, kind, name in chosen_plugins(plans)) == sorted(beside)
    assert main(["up", str(fleet), "--dry-run"]) == 0


@pytest.mark.parametrize(
    ("file", "old", "new", "said"),
    [
        ("red.py", "class Red:", "class Red", "SyntaxError"),
        ("red.py", "def detect", "def find", "Red without detect"),
        ("large.py", "class Large", "class Small", "Large"),
        ("large.py", "(Tracker)", "", "Large without "),
        ("sub/wide.py", "def lanes", "def lane", "Wide without lanes"),
        ("sub/wide.py", "class Wide:", "1 / 0\nclass Wide:", "ZeroDivisionError"),
        ("cautious.py", "(Strategy)", "", "Cautious without "),
        ("cautious.py", "import Strategy", "import Stratagem", "ImportError"),
        ("fleet.yaml", "red.py:Red", "red.py", "write FILE.py:CLASS"),
        ("fleet.yaml", "large.py:Large", "large.py", "FILE.py:CLASS"),
        ("fleet.yaml", "sub/wide.py:Wide", "wide.py:Wide", "wide.py"),
    ],
)
def test_a_mistake_in_a_plugin_is_told_before_anything_starts(
    fleet: Path,
    file: str,
    old: str,
    new: str,
    said: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = fleet.parent / file
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")
    assert main(["up", str(fleet), "--strict"]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert Path(file).name in error
    assert error.count("\n") == 1, error
    assert not Path("out").exists()


def test_a_dry_run_loads_plugins_too(fleet: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (fleet.parent / "red.py").write_text("class Red:", encoding="utf-8")
    assert main(["up", str(fleet), "--dry-run"]) == 2
    error = capsys.readouterr().err
    assert "red.py" in error
    line = next(k for k, text in enumerate(FLEET.splitlines(), 1) if "red.py" in text)
    assert f"fleet.yaml, line {line}," in error


def test_a_dry_run_reads_the_settings_of_scenes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "fleet.yaml"
    file.write_text("name: a\ncameras:\n  - {id: one, source: 'scene:s_curve?sze=640x360'}\n")
    assert main(["up", str(file), "--dry-run"]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "'sze'" in said
    assert "size" in said


def test_a_dry_run_shows_no_image_size_that_is_not_known(
    fleet: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["up", str(fleet), "--dry-run"]) == 0
    shown = capsys.readouterr().out
    assert "image_width" not in shown
    assert "Image sizes of north are asked for" in shown
    fleet.write_text(FLEET.replace("    model:", "    image_size: [960, 540]\n    model:"), "utf-8")
    assert main(["up", str(fleet), "--dry-run"]) == 0
    assert "image_width=960" in capsys.readouterr().out.replace("\n", "")
