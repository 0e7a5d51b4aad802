"""One registry: a decorator is all that a class of the package needs to be found everywhere."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from geoorbit_ros.core import plugins
from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.core.plugins import FOLDERS, register, registered
from geoorbit_ros.detection.detector import make_detector
from geoorbit_ros.federated.encodings.encoding import make_encoding
from geoorbit_ros.federated.strategies.strategy import make_strategy
from geoorbit_ros.lanes.estimators.estimator import make_estimator
from geoorbit_ros.tracking.tracker import make_tracker

ROOT = Path(__file__).parents[3]

DUMMIES = {
    "detection/dummy.py": """
from geoorbit_ros.core.plugins import register
from geoorbit_ros.detection.motion.detector import MotionDetector

@register("detector", "dummy_detector")
class Dummy(MotionDetector):
    name = "a dummy"
""",
    "lanes/estimators/dummy.py": """
from geoorbit_ros.core.plugins import register
from geoorbit_ros.lanes.estimators.curvilinear.estimator import CurvilinearEstimator

@register("estimator", "dummy_estimator")
class Dummy(CurvilinearEstimator):
    pass
""",
    "federated/strategies/dummy.py": """
from geoorbit_ros.core.plugins import register
from geoorbit_ros.federated.strategies.strategy import Strategy

@register("strategy", "dummy_strategy")
class Dummy(Strategy):
    pass
""",
    "tracking/dummy.py": """
from geoorbit_ros.core.plugins import register
from geoorbit_ros.tracking.tracker import Tracker

@register("tracker", "dummy_tracker")
class Dummy(Tracker):
    pass
""",
    "federated/encodings/dummy.py": """
from dataclasses import dataclass

from geoorbit_ros.core.plugins import register
from geoorbit_ros.federated.encodings.floats import Float32

@register("encoding", "dummy_encoding")
@dataclass(frozen=True)
class Dummy(Float32):
    code: int = 77
""",
}

QUESTIONS = """
import io, json, sys
from contextlib import redirect_stdout
from geoorbit_ros.cli.main import main

def help_of(command):
    with redirect_stdout(io.StringIO()) as text:
        main([command, "--help"])
    return text.getvalue().replace(" ", "").replace("\\n", "").replace("│", "")

for command, kinds in {"train": ("estimator", "strategy", "encoding"),
                       "process": ("detector", "estimator"), "track": ("tracker",)}.items():
    shown = help_of(command)
    for kind in kinds:
        assert f"dummy_{kind}" in shown, (command, kind, shown)

from geoorbit_ros.parameters import load_schema
for node, kind in (("lane_geometry", "estimator"), ("meta_client", "estimator"),
                   ("meta_client", "encoding"), ("federated_server", "encoding"),
                   ("federated_server", "strategy"), ("tracker", "tracker")):
    (spec,) = [spec for spec in load_schema(node) if spec.name == kind]
    assert spec.checked(f"dummy_{kind}", node) and f"dummy_{kind}" in spec.expected

from geoorbit_ros.fleet.fleet_file import Fleet
text = json.dumps(Fleet.model_json_schema())
assert all(f"dummy_{kind}" in text for kind in ("estimator", "strategy", "encoding", "tracker"))

from pathlib import Path
from geoorbit_ros.detection.detector import make_detector
from geoorbit_ros.federated.encodings.encoding import _by_code, make_encoding
from geoorbit_ros.federated.strategies.strategy import make_strategy
from geoorbit_ros.lanes.estimators.estimator import make_estimator
from geoorbit_ros.tracking.tracker import make_tracker
made = (make_detector(Path("dummy_detector")), make_estimator("dummy_estimator"),
        make_strategy("dummy_strategy"), make_encoding("dummy_encoding"),
        make_tracker("dummy_tracker"))
assert [type(one).__name__ for one in made] == ["Dummy"] * 5
assert 77 in _by_code()

sys.path.insert(0, "docs")
import make_parameter_tables
assert "dummy_strategy" in make_parameter_tables.table("federated_server")
"""


def test_a_file_with_a_decorator_is_all_that_a_new_class_of_any_kind_needs(tmp_path: Path) -> None:
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "geoorbit_ros", tmp_path / "geoorbit_ros", ignore=ignored)
    for folder in ("params", "docs"):
        (tmp_path / folder).symlink_to(ROOT / folder)
    for name, text in DUMMIES.items():
        (tmp_path / "geoorbit_ros" / name).write_text(text, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-c", QUESTIONS],
        cwd=tmp_path,
        env={"PYTHONPATH": str(tmp_path), "COLUMNS": "200", "HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


MAKERS: dict[str, Callable[[str], object]] = {
    "detector": lambda name: make_detector(Path(name)),
    "encoding": make_encoding,
    "estimator": make_estimator,
    "strategy": make_strategy,
    "tracker": make_tracker,
}


def test_a_file_changed_within_a_second_is_read_anew(tmp_path: Path) -> None:
    """Python keeps bytecode by the file's size and its time in seconds: the same for both."""
    file = tmp_path / "own.py"
    for found in ("one", "two"):
        file.write_text(
            "from geoorbit_ros.lanes.estimators.curvilinear.estimator import CurvilinearEstimator\n"
            f"class Own(CurvilinearEstimator):\n    found = '{found}'\n"
        )
        os.utime(file, (1e9, 1e9))
        assert make_estimator(f"{file}:Own").found == found  # type: ignore[attr-defined]
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize("kind", FOLDERS)
def test_every_name_that_is_listed_can_be_made(kind: str) -> None:
    for name in registered(kind):
        if name != "yolo":  # which needs a file
            assert MAKERS[kind](name) is not None


def test_numbers_of_encodings_are_their_own() -> None:
    codes = [make_encoding(name).code for name in registered("encoding")]
    assert len(set(codes)) == len(codes)


@pytest.mark.parametrize("kind", ["encoding", "estimator", "strategy", "tracker"])
def test_an_unknown_name_is_refused_with_those_that_are_known(kind: str) -> None:
    with pytest.raises(ParameterError) as error:
        MAKERS[kind]("no_such")
    assert all(name in str(error.value) for name in registered(kind))


def test_two_classes_of_one_name_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plugins, "_classes", {})

    class One: ...

    class Two: ...

    assert register("strategy", "mine")(One) is One
    assert register("strategy", "mine")(One) is One
    with pytest.raises(ParameterError, match="'mine' twice"):
        register("strategy", "mine")(Two)
    with pytest.raises(ParameterError, match="kind 'stratagem'"):
        register("stratagem", "mine")


def test_listing_and_making_what_is_light_import_nothing_heavy() -> None:
    code = (
        "import sys; from geoorbit_ros.core.plugins import FOLDERS, registered\n"
        "for kind in FOLDERS: registered(kind)\n"
        "assert 'numpy' not in sys.modules\n"
        "from geoorbit_ros.lanes.estimators.estimator import make_estimator\n"
        "from geoorbit_ros.detection.detector import make_detector\n"
        "from pathlib import Path\n"
        "make_estimator('curvilinear'), make_detector(Path('motion'))\n"
        "print(sorted({'sklearn', 'onnxruntime'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "[]", done.stderr
