"""`geoorbit twin forecast`, and the image of `twin replay`, as a user meets them."""

import json
from pathlib import Path

import cv2
import pytest

from geoorbit_ros.cli.main import main

Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def camera(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A made-up camera at a motorway: bag, calibration, network."""
    out = tmp_path_factory.mktemp("made") / "camera"
    arguments = ["--duration", "20", "--seed", "1", "--out", str(out)]
    assert main(["scene", "run", "straight_3x3", *arguments]) == 0
    return out


def run(capsys: Capture, camera: Path, command: str, *words: object) -> tuple[int, str]:
    """Exit code, and what was printed, on one line."""
    given = [camera / "bag", "--net", camera / "network.net.xml"]
    given += ["--calibration", camera / "calibration.csv"]
    code = main(["twin", command, *map(str, (*given, *words))])
    said = capsys.readouterr()
    return code, " ".join((said.out + said.err).split())


def test_a_forecast_with_and_without(camera: Path, tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "ahead"
    network = (camera / "network.net.xml").read_text()
    edge = network.partition('<lane id="')[2].partition("_0")[0].lstrip(":")
    words = ["--close-lane", f"{edge}_0", "--speed-limit", f"{edge}=60", "--minutes", 3]
    code, said = run(capsys, camera, "forecast", *words, "--out", out)
    assert code == 0, said
    assert f"{edge}_0 closed" in said
    values = json.loads((out / "forecast.json").read_text())
    as_it_is, changed = values["forecasts"]
    flow = {lane["lane"]: lane["flow_per_h"] for lane in changed["lanes"]}
    assert flow[f"{edge}_0"] == 0.0
    assert sum(lane["flow_per_h"] for lane in as_it_is["lanes"]) > 1000.0
    assert (out / "forecast.png").stat().st_size > 10_000


def test_a_lane_that_is_not_there_is_one_sentence(
    camera: Path, tmp_path: Path, capsys: Capture
) -> None:
    out = tmp_path / "ahead"
    code, said = run(capsys, camera, "forecast", "--close-lane", "nowhere_0", "--out", out)
    assert code == 2
    assert "found 'nowhere_0', expected a lane or an edge of the network" in said
    assert not out.exists()


def test_replay_shows_camera_and_twin_side_by_side(
    camera: Path, tmp_path: Path, capsys: Capture
) -> None:
    out = tmp_path / "twin"
    code, said = run(capsys, camera, "replay", "--no-align", "--out", out)
    assert code == 0, said
    assert "boxes seen and rendered" in said
    matched = int(said.partition("boxes seen and rendered: ")[2].split()[0])
    assert matched >= 5
    image = cv2.imread(str(out / "side_by_side_straight_3x3.png"))
    assert image is not None
    assert image.shape == (360, 1920, 3)
