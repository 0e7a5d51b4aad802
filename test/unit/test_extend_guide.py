"""The guide to detectors, estimators and strategies of one's own: each is one file, and works."""

import re
from pathlib import Path

import numpy as np
import pytest

from geoorbit_ros.cli.main import main
from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.core.tables import DETECTION_DTYPE
from geoorbit_ros.detection.detector import make_detector
from geoorbit_ros.federated.strategies.strategy import make_strategy
from geoorbit_ros.fleet.fleet_io import load_fleet
from geoorbit_ros.fleet.plan import chosen_plugins, plan_fleet
from geoorbit_ros.lanes.estimators.estimator import make_estimator
from geoorbit_ros.lanes.geojson import read_lanes
from geoorbit_ros.parameters import load_schema
from geoorbit_ros.tracking.tracker import make_tracker

ROOT = Path(__file__).parents[2]
GUIDE = (ROOT / "docs" / "guide-extend.md").read_text(encoding="utf-8")


@pytest.fixture
def written(tmp_path: Path) -> Path:
    """A folder with the files of the guide."""
    blocks = re.findall(r"```python\n# (\w+\.py)\n(.*?)```", GUIDE, re.DOTALL)
    assert [name for name, _ in blocks] == [
        *("red.py", "large.py", "single.py", "wide.py", "cautious.py"),
    ]
    for name, text in blocks:
        (tmp_path / name).write_text(text, encoding="utf-8")
    return tmp_path


def test_the_detector_finds_what_is_red(written: Path) -> None:
    detector = make_detector(Path(f"{written}/red.py:Red"))
    image = np.full((100, 200, 3), 90, np.uint8)
    image[40:60, 100:140] = (0, 0, 220)
    (box,) = detector.detect(1, image)
    assert box.dtype == DETECTION_DTYPE
    found = [float(box[key]) for key in ("x", "y", "width", "height")]
    assert found == pytest.approx([119.5, 49.5, 40.0, 20.0])


def test_the_tracker_follows_large_boxes_only(written: Path) -> None:
    tracker = make_tracker(f"{written}/large.py:Large")
    boxes = np.zeros(2, DETECTION_DTYPE)
    boxes["x"], boxes["y"], boxes["width"], boxes["score"] = [100, 300], 100, 40, 0.9
    boxes["height"] = [10, 30]
    (track,) = tracker.update(1, boxes)
    assert float(track["x"]) == 300.0


def test_the_estimators_show_what_the_guide_says_on_its_recording(written: Path) -> None:
    data = written / "data"
    scene = "scene run on_ramp_merge --duration 60 --seed 1 --out"
    assert scene in GUIDE
    assert main([*scene.split(), str(data)]) == 0
    words = ["lanes", "--tracks", f"{data}/tracks.csv", "--calibration", f"{data}/calibration.csv"]
    found = {}
    for name in ("curvilinear", "wide.py:Wide", "single.py:Single"):
        own = f"{written}/{name}" if ".py" in name else name
        out = written / f"{name[:6]}.geojson"
        assert main([*words, "--estimator", own, "--out", str(out)]) == 0
        found[name] = read_lanes(out).lanes
    every, wide, single = found.values()
    assert (len(every), len(wide), len(single)) == (4, 2, 1)
    assert {lane.lane_id for lane in wide} <= {lane.lane_id for lane in every}
    assert all(lane.width_m > 3.72 for lane in wide)


def test_the_fleet_of_the_guide_loads_its_plugins(written: Path) -> None:
    (block,) = re.findall(r"```yaml\n(.*?)```", GUIDE, re.DOTALL)
    fleet = written / "fleet.yaml"
    fleet.write_text(block, encoding="utf-8")
    (written / "out/plugin_film").mkdir(parents=True)
    for name in ("video.mp4", "calibration.csv"):
        (written / "out/plugin_film" / name).touch()
    assert main(["up", str(fleet), "--dry-run"]) == 0
    content, _ = load_fleet(fleet)
    plans = plan_fleet(content, fleet.parent, fleet.parent / "out")
    kinds = sorted(kind for _, kind, _ in chosen_plugins(plans))
    assert kinds == ["detector", "estimator", "estimator", "strategy", "tracker"]


def test_the_strategy_takes_half_a_step(written: Path) -> None:
    strategy = make_strategy(f"{written}/cautious.py:Cautious")
    np.testing.assert_array_equal(strategy.step(np.array([2.0, -4.0])), [1.0, -2.0])


def test_parameters_of_nodes_take_a_class_where_a_factory_does() -> None:
    for node, name in (
        ("lane_geometry", "estimator"),
        ("meta_client", "estimator"),
        ("federated_server", "strategy"),
    ):
        spec = next(spec for spec in load_schema(node) if spec.name == name)
        assert spec.checked("mine.py:Mine", node) == "mine.py:Mine"
        with pytest.raises(ParameterError, match=r"or FILE\.py:CLASS"):
            spec.checked("mine", node)


@pytest.mark.parametrize(
    ("text", "name", "said"),
    [
        ("", "Nothing", "no class Nothing"),
        ("1 / 0", "Mine", "ZeroDivisionError"),
        ("class Mine:\n    def add(self, stamp_ns, rows): ...", "Mine", "Mine without lanes, "),
        ("class Mine:\n    def __init__(self, x): ...", "Mine", "Mine(), without arguments"),
    ],
)
def test_what_is_wrong_with_a_file_is_one_sentence(
    tmp_path: Path, text: str, name: str, said: str
) -> None:
    file = tmp_path / "mine.py"
    file.write_text(text)
    with pytest.raises(ParameterError, match=re.escape(said)) as error:
        make_estimator(f"{file}:{name}")
    assert "\n" not in str(error.value)
    with pytest.raises(ParameterError, match=r"no file .*none\.py"):
        make_estimator(f"{tmp_path}/none.py:Mine")
