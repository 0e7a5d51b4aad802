"""`geoorbit twin validate` and `patch` as a user meets them."""

import json
from pathlib import Path

import pytest
from made_detections import detected
from made_twin import DATUM, made_network

from geoorbit_ros.cli.main import main
from geoorbit_ros.core.lanes import LaneMap
from geoorbit_ros.lanes.geojson import write_lanes
from geoorbit_ros.roadnet.network import load_network
from scores.map_errors import plant


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A right network, one with a narrow lane, and lanes seen."""
    place = tmp_path_factory.mktemp("maps")
    network = load_network(made_network(place), DATUM)
    (place / "plain").mkdir()
    plant("width", network, "west_0", place / "narrow.net.xml", place / "plain")
    lanes = LaneMap(0, tuple(detected(network)))
    write_lanes(place / "lanes.geojson", lanes, DATUM, camera_id="north")
    return place


Capture = pytest.CaptureFixture[str]


def run(capsys: Capture, *words: object) -> tuple[int, str]:
    """Exit code, and what was printed, on one line."""
    code = main(["twin", *map(str, words)])
    said = capsys.readouterr()
    return code, " ".join((said.out + said.err).split())


def test_validate_writes_report_and_picture(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    net, out = folder / "narrow.net.xml", tmp_path / "check"
    code, said = run(capsys, "validate", folder / "lanes.geojson", "--net", net, "--out", out)
    assert code == 0, said
    assert "west_0 is 3.50 m wide, by the map 2.70 m" in said
    report = json.loads((out / "report.json").read_text())
    assert [(f["kind"], f["lane"]) for f in report["findings"]] == [("width", "west_0")]
    assert abs(report["findings"][0]["latitude_deg"] - DATUM.latitude_deg) < 0.01
    assert (out / "validation.png").stat().st_size > 10_000


def test_patch_writes_a_network_without_findings(
    folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    net, out = folder / "narrow.net.xml", tmp_path / "corrected"
    code, said = run(capsys, "patch", folder / "lanes.geojson", "--net", net, "--out", out)
    assert code == 0, said
    record = json.loads((out / "patch.json").read_text())
    assert record["after"]["findings"] == []
    assert "--edge-files=base.edg.xml,patch.edg.xml" in record["netconvert"]["options"]
    assert 'id="west"' in (out / "patch/patch.edg.xml").read_text()
    code, said = run(
        capsys,
        "validate",
        folder / "lanes.geojson",
        "--net",
        out / "network.net.xml",
        "--out",
        out / "b",
    )
    assert "No findings" in said


@pytest.mark.parametrize("command", ["validate", "patch"])
@pytest.mark.parametrize(
    ("net", "expected"),
    [
        ("<net><edge", "broken XML"),
        ("<net></net>", "no lane for road vehicles"),
        ("nowhere", "a network without projection"),
        ("elsewhere", "no lane near the detected ones"),
        (None, "no such file"),
    ],
)
def test_bad_input_is_one_sentence(
    folder: Path, tmp_path: Path, command: str, net: str | None, expected: str, capsys: Capture
) -> None:
    right = (folder / "scene.net.xml").read_text()
    place = DATUM.proj_string
    text = {
        "nowhere": right.replace(f'projParameter="{place}"', 'projParameter="!"'),
        "elsewhere": right.replace("+lat_0=43.05", "+lat_0=43.15"),
    }.get(str(net), net)
    file, out = tmp_path / "area.net.xml", tmp_path / "out"
    if text is not None:
        file.write_text(text)
    code, said = run(capsys, command, folder / "lanes.geojson", "--net", file, "--out", out)
    assert code == 2
    assert expected in said
    assert not out.exists()
