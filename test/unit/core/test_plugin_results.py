"""Results of plug-ins are checked in full, and so are names and arguments of their methods."""

import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from geoorbit_ros.core.errors import GeoOrbitError, ParameterError, PluginError
from geoorbit_ros.core.tables import DETECTION_DTYPE, TRACK_DTYPE
from geoorbit_ros.detection.detector import make_detector
from geoorbit_ros.federated.strategies.strategy import Strategy, make_strategy
from geoorbit_ros.lanes.estimators.estimator import make_estimator
from geoorbit_ros.lanes.parameters import LaneParameters
from geoorbit_ros.tracking.tracker import make_tracker

STAMPS_NS = (3_000_000_000, 4_000_000_000)

ESTIMATOR = """import numpy as np
from geoorbit_ros.core.lanes import Lane, LaneMap
L = np.array([[0.0, 0.0], [0.0, 50.0]])
S = np.array([1.8, 0.0])
def lane(**more):
    return Lane(**{{**dict(lane_id=1, centerline_m=L, left_m=L - S, right_m=L + S, width_m=3.6,
                width_sigma_m=0.5, confidence=0.9, status="confirmed", vehicles=9), **more}})
class Own:
    def add(self, stamp_ns, rows):
        self.stamp_ns = stamp_ns
    def lanes(self, parameters):
        return LaneMap({stamp}, ({lane},))
    {more}
"""
STRATEGY = """import numpy as np
from geoorbit_ros.federated.strategies.strategy import RobustStrategy, Strategy
class Half:
    number = 0
    def __init__(self, size): self.size = size
    def add(self, client, update, weight): self.number += {grow}
    def result(self): return {result}
class Own({base}):
    {body}
"""
DETECTOR = """import numpy as np
from geoorbit_ros.core.tables import DETECTION_DTYPE
class Own:
    {name}
    def warm_up(self, images): ...
    def detect(self, stamp_ns, image):
        rows = np.ones(2, DETECTION_DTYPE)
        {body}
        return rows
"""
TRACKER = """import numpy as np
from geoorbit_ros.core.tables import PIXEL_TRACK_DTYPE
from geoorbit_ros.tracking.tracker import Tracker
class Own(Tracker):
    {head}
    def update(self, stamp_ns, detections):
        rows = np.ones(2, PIXEL_TRACK_DTYPE)
        rows["track_id"] = 1, 2
        {body}
        return rows
"""


def write(folder: Path, text: str) -> str:
    (folder / "own.py").write_text(text, encoding="utf-8")
    return f"{folder}/own.py:Own"


def estimate(
    folder: Path, lane: str = "lane()", stamp: str = "self.stamp_ns", more: str = ""
) -> Any:
    own = make_estimator(write(folder, ESTIMATOR.format(lane=lane, stamp=stamp, more=more)))
    for stamp_ns in STAMPS_NS:
        own.add(stamp_ns, np.zeros(2, TRACK_DTYPE))
    return own.lanes(LaneParameters())


def strategy(
    folder: Path, body: str, base: str = "Strategy", grow: str = "1", result: str = "np.ones(3)"
) -> Strategy:
    return make_strategy(
        write(folder, STRATEGY.format(body=body, base=base, grow=grow, result=result))
    )


def a_round(own: Strategy) -> Any:
    updates = own.collection(3)
    updates.add(1, np.ones(3, np.float32), own.weight(5, 0))
    change = own.step(updates.result())
    own.restore(own.state())
    return change


WRONG_LANES = [
    ("status='ok'", "status 'ok'"),
    ("status=True", "status True"),
    ("width_m='wide'", "width_m 'wide'"),
    ("width_m=-1.0", "width_m -1"),
    ("width_m=0.0", "width_m 0"),
    ("width_m=np.nan", "width_m nan"),
    ("width_m=360.0", "width_m 360"),
    ("width_sigma_m=None", "width_sigma_m None"),
    ("width_sigma_m=-0.1", "width_sigma_m -0.1"),
    ("confidence=90", "confidence 90, not a number from 0 to 1"),
    ("confidence=True", "confidence True"),
    ("vehicles=[1, 2]", "vehicles [1, 2]"),
    ("vehicles=-3", "vehicles -3"),
    ("vehicles=np.inf", "vehicles inf"),
    ("vehicles_missing=1.5", "vehicles_missing 1.5"),
    ("sigma_m='small'", "sigma_m 'small'"),
    ("evidence={}", "a dict as evidence"),
    ("lane_id='west'", "lane_id 'west'"),
    ("centerline_m=L + 1e7", "away from all tracks"),
    ("left_m=L + S, right_m=L - S", "left_m that is not to the left of right_m"),
    ("left_m=L, right_m=L", "left_m that is not to the left of right_m"),
    ("left_m=np.vstack([L, [0.0, 60.0]])", "left_m with 3 points, not 2"),
    ("centerline_m=L * 0", "centerline_m of 0 m length"),
    ("right_m=L * 0", "right_m of 0 m length"),
    ("centerline_m=L.astype(np.float32)", "float32 in centerline_m"),
    ("right_m=L[:1]", "right_m of shape (1, 2)"),
]


@pytest.mark.parametrize(("fields", "said"), WRONG_LANES)
def test_every_field_of_a_lane_is_checked(tmp_path: Path, fields: str, said: str) -> None:
    with pytest.raises(PluginError, match=rf"Own\.lanes: found lane 0: .*{re.escape(said)}"):
        estimate(tmp_path, f"lane({fields})")


@pytest.mark.parametrize(
    "stamp", ["0", "None", "self.stamp_ns / 1e9", "self.stamp_ns + 1", "True", "'3'"]
)
def test_the_stamp_of_a_map_is_that_of_a_frame_in_nanoseconds(tmp_path: Path, stamp: str) -> None:
    with pytest.raises(PluginError, match=r"Own\.lanes: found stamp_ns "):
        estimate(tmp_path, stamp=stamp)


def test_what_is_not_known_may_be_not_a_number_and_numbers_may_be_of_numpy(tmp_path: Path) -> None:
    unknown = (
        "width_sigma_m=np.nan, vehicles=np.nan, confidence=np.float32(0.5), lane_id=np.int64(3)"
    )
    (lane,) = estimate(tmp_path, f"lane({unknown})").lanes
    assert np.isnan(lane.vehicles)
    assert estimate(tmp_path, stamp=str(STAMPS_NS[0])).stamp_ns == STAMPS_NS[0]


@pytest.mark.parametrize(
    ("state", "said"), [("[1]", "a list"), ("{1: 2}", "the key 1"), ("{'a': 2}", "an int as 'a'")]
)
def test_a_state_is_arrays_by_name(tmp_path: Path, state: str, said: str) -> None:
    more = f"def state(self): return {state}\n    def restore(self, state, stamp_ns): ..."
    estimate(tmp_path, more=more)
    own: Any = make_estimator(f"{tmp_path}/own.py:Own")
    with pytest.raises(PluginError, match=rf"Own\.state: found {re.escape(said)}"):
        own.state()
    with pytest.raises(PluginError, match=rf"Own\.state: found {re.escape(said)}"):
        strategy(tmp_path, f"def state(self): return {state}").state()


def test_a_state_that_an_estimator_cannot_take_back_names_its_method(tmp_path: Path) -> None:
    more = "def state(self): return {}\n    def restore(self, state, stamp_ns): state['weights']"
    estimate(tmp_path, more=more)
    own: Any = make_estimator(f"{tmp_path}/own.py:Own")
    with pytest.raises(PluginError, match=r"Own\.restore: found KeyError: 'weights'"):
        own.restore({}, 5)


@pytest.mark.parametrize(
    ("body", "more", "said"),
    [
        ("def collection(self, size): return np.zeros(size)", {}, "Own.collection: found a numpy"),
        (
            "def collection(self, size): return None",
            {},
            "Own.collection: found None without number",
        ),
        ("def collection(self, size): return Half(size)", {"grow": "x"}, "Half.add: found NameErr"),
        (
            "def collection(self, size): return Half(size)",
            {"result": "[1.0]"},
            "result: found a list",
        ),
        ("def collection(self, size): return Half(size)", {"result": "np.ones(4)"}, "shape (4,)"),
        ("def weight(self, count, staleness): return 0.0", {}, "result: found float64 values"),
        ("def weight(self, count, staleness): return 1e30", {}, "Own.weight: found 1e+30"),
        (
            "def step(self, aggregate): return aggregate + 1e30",
            {},
            "own.py, line 9, Own.step: found",
        ),
        ("def step(self, aggregate): return aggregate + 1j", {}, "complex128 values, not float64"),
        ("def step(self, aggregate): raise SystemExit(3)", {}, "Own.step: found SystemExit: 3"),
        (
            "def combine(self, table): return table[0] * np.nan",
            {"base": "RobustStrategy"},
            "3 of 3",
        ),
        ("def state(self): return {}\n    def restore(self, s): 1 / 0", {}, "found ZeroDivision"),
    ],
)
def test_what_a_strategy_gives_is_checked(
    tmp_path: Path, body: str, more: dict[str, str], said: str
) -> None:
    own = strategy(tmp_path, body, **more)
    with np.errstate(all="ignore"), pytest.raises(PluginError) as error:
        a_round(own)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("value", ["'many'", "-1", "float('nan')"])
def test_numbers_of_a_strategy_are_checked_when_it_is_made(tmp_path: Path, value: str) -> None:
    for name in ("buffer_size", "proximal_mu"):
        with pytest.raises(PluginError, match=rf"Own\.{name}: found "):
            strategy(tmp_path, f"{name} = {value}")


def test_a_collection_of_a_plugin_gives_its_own_result(tmp_path: Path) -> None:
    own = strategy(
        tmp_path, "def collection(self, size): return Half(size)", result="np.full(3, 2.)"
    )
    assert a_round(own).tolist() == [2.0] * 3


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("rows['score'] = 7.0", "row 0: score 7"),
        ("rows['score'] = -0.1", "row 0: score -0.1"),
        ("rows['class_id'] = 1, 9999", "row 1: class_id 9999"),
        ("rows['class_id'] = -2", "row 0: class_id -2"),
        ("raise SystemExit(3)", "SystemExit: 3"),
        ("raise NotImplementedError", "found NotImplementedError, expected no error"),
    ],
)
def test_scores_and_classes_lie_within_their_ranges(tmp_path: Path, body: str, said: str) -> None:
    own = make_detector(Path(write(tmp_path, DETECTOR.format(name="name = 'x'", body=body))))
    with pytest.raises(PluginError) as error:
        own.detect(1, np.zeros((20, 30, 3), np.uint8))
    assert said in str(error.value)
    if body.startswith("rows"):
        tracker = make_tracker(write(tmp_path, TRACKER.format(head="", body=body)))
        with pytest.raises(PluginError, match=re.escape(said)):
            tracker.update(1, np.zeros(0, DETECTION_DTYPE))


@pytest.mark.parametrize(
    ("head", "body", "said"),
    [
        ("", "rows['track_id'] = 1", "track_id 1 in 2 rows"),
        ("", "rows['track_id'] = 0, 1", "track_id 0"),
        ("lost = property(lambda self: 1 / 0)", "", "ZeroDivisionError"),
        ("alive = 'all'", "", "Own.alive: found 'all'"),
        ("counts = property(lambda self: {}, lambda self, value: None)", "", "found a dict"),
    ],
)
def test_ids_and_counts_of_a_tracker_are_checked(
    tmp_path: Path, head: str, body: str, said: str
) -> None:
    name = write(tmp_path, TRACKER.format(head=head, body=body))
    with pytest.raises(PluginError) as error:
        make_tracker(name).update(1, np.zeros(0, DETECTION_DTYPE))
    assert said in str(error.value)


ROBUST = "RobustStrategy"
LOADED = [
    ("def combine(self, table, weights): ...", ROBUST, "found Own.combine(self, table, weights)"),
    ("def combin(self, table): ...", ROBUST, "Own without combine (combin for combine?)"),
    ("def collection(self): ...", "Strategy", "expected collection(self, size)"),
    ("def restore(self): ...", "Strategy", "expected restore(self, state)"),
    ("step = 3", "Strategy", "found an int, which is no method"),
    (
        "def __init__(self, share): ...",
        "Strategy",
        "missing 1 required positional",
    ),
    ("@classmethod\n    def from_settings(cls): ...", "Strategy", "from_settings(cls, settings)"),
    ("def from_settings(self, settings): ...", "Strategy", "which is no class method"),
    ("def step(self, aggregate): ...", "object", "expected class Own(Strategy): from geoorbit_ros"),
]


@pytest.mark.parametrize(("body", "base", "said"), LOADED)
def test_missing_methods_and_wrong_arguments_are_told_when_a_class_is_loaded(
    tmp_path: Path, body: str, base: str, said: str
) -> None:
    with pytest.raises(ParameterError) as error:
        strategy(tmp_path, body, base)
    assert said in str(error.value)
    assert "geoorbit_plugin" not in str(error.value)


def test_a_misspelt_method_is_warned_of_with_file_and_name(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match=r"Own\.wieght is never called: is it meant to be weight"):
        strategy(tmp_path, "def wieght(self, count, staleness): return 1.0")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        strategy(tmp_path, "def helper(self): ...\n    def _steps(self): ...")


def test_a_protocol_that_is_only_inherited_is_missing(tmp_path: Path) -> None:
    text = (
        "from geoorbit_ros.lanes.estimators.estimator import LaneEstimator\n"
        "class Own(LaneEstimator):\n    def add(self, stamp_ns, rows): ...\n"
    )
    with pytest.raises(
        ParameterError, match=r"Own without lanes, expected add, lanes: all of Lane"
    ):
        make_estimator(write(tmp_path, text))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("class Owner: ...", "no class Own (the file has Owner), expected 'Owner'?"),
        ("x = 1", "no class Own (the file has no class), expected the name of a class in the file"),
        ("import no_such_module", "No module named 'no_such_module', expected a file that can be"),
        ("class Own:", "found IndentationError"),
        ("raise SystemExit(3)", "line 1: found SystemExit: 3, expected a file that can be loaded"),
        ("def Own(): ...", "found Own, which is no class"),
    ],
)
def test_a_file_without_the_class_says_what_it_has(tmp_path: Path, text: str, said: str) -> None:
    name = write(tmp_path, text)
    for make in (make_strategy, make_estimator, make_tracker, lambda n: make_detector(Path(n))):
        with pytest.raises(GeoOrbitError) as error:
            make(name)
        assert said in str(error.value)
        assert "geoorbit_plugin" not in str(error.value)
