"""A mistake of a plug-in while it runs is one sentence: file, line, method, what it should."""

import pickle
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from geoorbit_ros.cli.main import main
from geoorbit_ros.core.errors import GeoOrbitError, ParameterError, PluginError
from geoorbit_ros.core.lanes import Lane, LaneMap
from geoorbit_ros.core.tables import DETECTION_DTYPE, PIXEL_TRACK_DTYPE
from geoorbit_ros.detection.detector import DetectorSettings, make_detector, without_effect
from geoorbit_ros.federated.strategies.strategy import make_strategy
from geoorbit_ros.lanes.estimators.estimator import make_estimator
from geoorbit_ros.lanes.parameters import LaneParameters
from geoorbit_ros.tracking.tracker import make_tracker

IMAGE = np.zeros((20, 30, 3), np.uint8)
BOXES = np.zeros(0, DETECTION_DTYPE)

DETECTOR = """import numpy as np
from geoorbit_ros.core.tables import DETECTION_DTYPE
class Own:
    name = "own"
    def warm_up(self, images): ...
    def detect(self, stamp_ns, image):
        {}
"""
TRACKER = """import numpy as np
from geoorbit_ros.core.tables import PIXEL_TRACK_DTYPE
from geoorbit_ros.tracking.tracker import Tracker
class Own(Tracker):

    def update(self, stamp_ns, detections):
        {}
"""
ESTIMATOR = """import numpy as np
from geoorbit_ros.core.lanes import Lane, LaneMap
class Own:
    def add(self, stamp_ns, rows): ...

    def lanes(self, parameters):
        {}
"""
STRATEGY = """import numpy as np
from geoorbit_ros.federated.strategies.strategy import Strategy
class Own(Strategy):


    def step(self, aggregate):
        {}
"""
LINE = "np.array([[0.0, 0.0], [0.0, 20.0], [0.0, 50.0]])"
LANE = f"Lane(1, {{}}, {LINE} - [1.8, 0.0], {LINE} + [1.8, 0.0], 3.5, 0.1, {{}}, 'confirmed', 5.0)"

Run = Callable[[str], Any]


def detector(name: str) -> Any:
    return make_detector(Path(name)).detect(1, IMAGE)


def tracker(name: str) -> Any:
    return make_tracker(name).update(1, BOXES)


def estimator(name: str) -> Any:
    return make_estimator(name).lanes(LaneParameters())


def strategy(name: str) -> Any:
    return make_strategy(name).step(np.ones(3))


def write(folder: Path, text: str, body: str) -> str:
    file = folder / "own.py"
    file.write_text(text.format(body), encoding="utf-8")
    return f"{file}:Own"


MISTAKES = [
    (detector, DETECTOR, "return", "None"),
    (detector, DETECTOR, "return []", "a list"),
    (detector, DETECTOR, "return np.zeros(3)", "float64 values"),
    (detector, DETECTOR, "return np.zeros((2, 2), DETECTION_DTYPE)", "shape (2, 2)"),
    (detector, DETECTOR, "r = np.zeros(2, DETECTION_DTYPE); r['x'] = np.nan; return r", "row 0"),
    (tracker, TRACKER, "return detections", "fields x, y"),
    (tracker, TRACKER, "return None", "None"),
    (estimator, ESTIMATOR, "return ()", "a tuple"),
    (estimator, ESTIMATOR, "return LaneMap(1, (3,))", "lane 0: an int"),
    (estimator, ESTIMATOR, f"return LaneMap(1, ({LANE.format('[1, 2]', 1.0)},))", "a list as"),
    (estimator, ESTIMATOR, f"return LaneMap(1, ({LANE.format('np.zeros(2)', 1.0)},))", "(2,)"),
    (
        estimator,
        ESTIMATOR,
        f"return LaneMap(1, ({LANE.format(LINE + ' + np.inf', 1.0)},))",
        "finite",
    ),
    (estimator, ESTIMATOR, f"return LaneMap(1, ({LANE.format(LINE, 9.0)},))", "confidence 9"),
    (strategy, STRATEGY, "return aggregate[1:]", "shape (2,), not (3,)"),
    (strategy, STRATEGY, "return aggregate * np.nan", "not all finite"),
    (strategy, STRATEGY, "return None", "None"),
]


@pytest.mark.parametrize(("run", "text", "body", "said"), MISTAKES)
def test_a_wrong_result_names_the_method_and_what_it_should_return(
    tmp_path: Path, run: Run, text: str, body: str, said: str
) -> None:
    name = write(tmp_path, text, body)
    with pytest.raises(PluginError) as error:
        run(name)
    sentence = str(error.value)
    start = rf"{tmp_path}/own\.py, line 6, Own\.\w+: found .*{re.escape(said)}.*, expected "
    assert re.match(start, sentence), sentence
    assert "\n" not in sentence


@pytest.mark.parametrize(
    ("run", "text"),
    [
        (detector, DETECTOR),
        (tracker, TRACKER),
        (estimator, ESTIMATOR),
        (strategy, STRATEGY),
    ],
)
def test_an_exception_names_the_line_of_the_plugin(tmp_path: Path, run: Run, text: str) -> None:
    name = write(tmp_path, text, "return np.linalg.inv(np.zeros((2, 2)))")  # fails inside numpy
    with pytest.raises(PluginError, match=r"own\.py, line 7, Own\.\w+: found LinAlgError: Sing"):
        run(name)


@pytest.mark.parametrize(
    ("run", "text", "right", "wrong"),
    [
        (detector, DETECTOR, "(self, stamp_ns, image)", "(self, image)"),
        (tracker, TRACKER, "(self, stamp_ns, detections)", "(self, detections)"),
        (estimator, ESTIMATOR, "(self, parameters)", "(self)"),
        (strategy, STRATEGY, "(self, aggregate)", "(self, aggregate, rate)"),
    ],
)
def test_a_wrong_signature_is_refused_when_the_file_is_loaded(
    tmp_path: Path, run: Run, text: str, right: str, wrong: str
) -> None:
    name = write(tmp_path, text.replace(right, wrong), "pass")
    with pytest.raises(ParameterError) as error:
        run(name)
    assert wrong in str(error.value)
    assert str(error.value).endswith(right)
    assert "own.py, line 6" in str(error.value)


def test_a_command_ends_with_the_sentence_and_status_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name = write(tmp_path, TRACKER, "return None")
    boxes, out = tmp_path / "det.txt", tmp_path / "tracks.txt"
    boxes.write_text("1,-1,10,10,20,20,0.9,2,-1,-1\n", encoding="utf-8")
    words = ["track", "--detections", str(boxes), "--fps", "10", "--tracker", name]
    assert main([*words, "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert "own.py, line 6, Own.update: found None, expected (N,) rows of PIXEL_TRACK_" in error
    assert not out.exists()


def test_the_error_survives_the_way_from_a_worker(tmp_path: Path) -> None:
    with pytest.raises(PluginError) as error:
        strategy(write(tmp_path, STRATEGY, "return None"))
    again = pickle.loads(pickle.dumps(error.value))
    assert (type(again), str(again)) == (PluginError, str(error.value))


def test_right_results_and_errors_on_purpose_pass(tmp_path: Path) -> None:
    body = "r = np.zeros(2, DETECTION_DTYPE); r['score'] = 0.2, 0.3; return r"
    assert len(detector(write(tmp_path, DETECTOR, body))) == 1  # the lowest score is 0.25
    empty = write(tmp_path, TRACKER, "return np.zeros(0, PIXEL_TRACK_DTYPE)")
    assert tracker(empty).dtype == PIXEL_TRACK_DTYPE
    good = write(tmp_path, ESTIMATOR, f"return LaneMap(1, ({LANE.format(LINE, 0.7)},))")
    found = estimator(good)
    assert isinstance(found, LaneMap)
    assert isinstance(found.lanes[0], Lane)
    own = "from geoorbit_ros.detection.detector import ImageError; raise ImageError('i', 'a', 'b')"
    with pytest.raises(GeoOrbitError, match=r"^i: found a, expected b$"):
        detector(write(tmp_path, DETECTOR, own))


def test_the_lowest_score_holds_for_a_plugin_and_names_of_classes_do_not(tmp_path: Path) -> None:
    body = "r = np.zeros(3, DETECTION_DTYPE); r['score'] = 0.2, 0.5, 0.9; return r"
    name = write(tmp_path, DETECTOR, body)
    settings = DetectorSettings(min_score=0.6, class_names=("car",))
    own = make_detector(Path(name), settings)
    assert own.detect(1, IMAGE)["score"].tolist() == [np.float32(0.9)]
    assert "no effect" in str(without_effect(own, settings))
    assert without_effect(own, DetectorSettings()) is None
    assert without_effect(make_detector(None, settings), settings) is None


def test_the_name_of_a_class_is_asked_for(tmp_path: Path) -> None:
    for make in (detector, tracker, estimator, strategy):
        with pytest.raises(ParameterError, match=r"write FILE\.py:CLASS"):
            make(f"{tmp_path}/own.py")


def test_a_plugin_may_be_a_dataclass_and_be_called_as_a_library_is(tmp_path: Path) -> None:
    text = (
        "from __future__ import annotations\nfrom dataclasses import dataclass\n"
        "import numpy as np\nfrom geoorbit_ros.federated.strategies.strategy import Strategy\n"
        "@dataclass\nclass Own(Strategy):\n    share: float = 0.5\n"
        "    def step(self, aggregate):\n        return self.share * np.asarray(aggregate)\n"
    )
    (tmp_path / "numpy.py").write_text(text, encoding="utf-8")
    assert make_strategy(f"{tmp_path}/numpy.py:Own").step(np.ones(2)).tolist() == [0.5, 0.5]
