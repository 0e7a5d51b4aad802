"""Fleet files as people write them: read as meant, or the one camera left out and told."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from made_bags import TRACKS, MadeMcap, tables

from geoorbit_ros.cli.main import main
from geoorbit_ros.core.errors import InputFileError, ParameterError
from geoorbit_ros.core.input_report import InputReport
from geoorbit_ros.core.tables import PIXEL_TRACK_DTYPE, Frames
from geoorbit_ros.fleet.fleet_file import Fleet
from geoorbit_ros.fleet.fleet_io import load_fleet
from geoorbit_ros.fleet.prepare import ask_sources, leave_out_missing
from geoorbit_ros.parameters import ParameterSpec, Value
from geoorbit_ros.scenes.scene import Scene
from geoorbit_ros.storage.track_bag import write_track_bag
from geoorbit_ros.storage.yaml_file import read_yaml

GOOD = """\
name: crossing
cameras:
  - id: north
    source: scene:s_curve
    parameters:
      lane_geometry: {update_period_s: 2}
      homography: {reject_truncated: true}
  - id: south
    source: scene:lane_drop
    enabled: true
    datum:
      latitude_deg: 43.25
      longitude_deg: -89.4
  - id: east
    source: scene:s_curve
twin: {network: roads.net.xml}
recorder: {folder: databases}
viewer: {port: 8765}
"""


def read(tmp_path: Path, content: str | bytes) -> tuple[Fleet, str]:
    """The fleet, and what was said about its file."""
    file = tmp_path / "fleet.yaml"
    data = content.encode() if isinstance(content, str) else content
    file.write_bytes(data)
    report = InputReport(str(file), "cameras")
    return load_fleet(file, report)[0], " ".join(report.sentences())


def test_a_right_fleet_is_read_as_without_a_report(tmp_path: Path) -> None:
    fleet, told = read(tmp_path, GOOD)
    assert told == ""
    assert fleet == load_fleet(tmp_path / "fleet.yaml")[0]


SAME: list[tuple[str, str | bytes, str]] = [
    ("a byte order mark", "\ufeff" + GOOD, "^$"),
    ("UTF-16", GOOD.encode("utf-16"), "^$"),
    ("line ends of Windows", GOOD.replace("\n", "\r\n"), "^$"),
    ("tabs", re.sub(r"^( +)", lambda m: "\t" * (len(m[1]) // 2), GOOD, flags=re.M), "tabs in"),
    ("numbers in quotes", GOOD.replace("update_period_s: 2", "update_period_s: '2'"),
     "update_period_s: '2' is read as 2"),
    ("numbers in quotes where only numbers can be", GOOD.replace("8765", "'8765'"), "^$"),
    ("a whole number with a point", GOOD.replace("8765", "8765.0"), "^$"),
    ("yes", GOOD.replace("truncated: true", "truncated: yes"), "'yes' is read as True"),
    ("on", GOOD.replace("enabled: true", "enabled: on"), "^$"),
    ("a decimal comma", GOOD.replace("43.25", "43,25"), "latitude_deg: '43,25' is read as 43.25"),
    ("a leading zero", GOOD.replace("port: 8765", "port: 08765"), "^$"),
    ("an exponent", GOOD.replace("43.25", "4325e-2"), "^$"),
    ("a key for anchors", "x-all: &all {enabled: true}\n" + GOOD.replace(
        "enabled: true", "<<: *all"), "^$"),
    ("a key that is not known", "veiwer: {}\n" + GOOD,
     "veiwer is left out: found an unknown key, expected 'viewer'?"),
    ("cameras by their ids", re.sub(r"- id: (\w+)", r"\1:", GOOD), "read as a list"),
]  # fmt: skip


@pytest.mark.parametrize(("_name", "content", "sentence"), SAME, ids=[name for name, *_ in SAME])
def test_written_in_another_way_it_is_the_same_fleet(
    tmp_path: Path, _name: str, content: str | bytes, sentence: str
) -> None:
    expected, _ = read(tmp_path, GOOD)
    fleet, told = read(tmp_path, content)
    assert fleet == expected
    assert re.search(sentence, told), told


def test_a_fleet_needs_no_name_and_any_name_will_do(tmp_path: Path) -> None:
    fleet, told = read(tmp_path, GOOD.replace("name: crossing\n", ""))
    assert fleet.name == "fleet"
    assert "becomes 'fleet'" in told
    fleet, told = read(tmp_path, GOOD.replace("crossing", "Kreuzung 4, Süd"))
    assert re.fullmatch(r"[A-Za-z]\w*", fleet.name, re.ASCII)
    assert fleet.name in told


@pytest.mark.parametrize("word", ["true", "yes", "on", "{}", "''"])
def test_a_service_that_is_only_switched_on(tmp_path: Path, word: str) -> None:
    fleet, _ = read(tmp_path, GOOD.replace("viewer: {port: 8765}", f"viewer: {word}"))
    assert (fleet.viewer is not None and fleet.viewer.port == 8765) == (word != "''")
    fleet, _ = read(tmp_path, GOOD.replace("viewer: {port: 8765}", "viewer: off"))
    assert fleet.viewer is not None
    assert not fleet.viewer.enabled


@pytest.mark.parametrize("word", ["no", "on", "12", "1e3", "north-1", "Straße", "2nd", "a b", "''"])
def test_an_id_that_is_no_ros_name_is_named_as_it_is_written(tmp_path: Path, word: str) -> None:
    content = GOOD.replace("id: south", f"id: {word}")
    if word in ("no", "on"):  # words in YAML 1.2
        assert read(tmp_path, content)[0].cameras[1].id == word
        return
    fleet, told = read(tmp_path, content)
    assert [camera.id for camera in fleet.cameras] == ["north", "east"]
    assert "line 8, key 'cameras[1].id'" in told
    assert "1 of 3 cameras left out" in told


LEFT_OUT: list[tuple[str, str, str, str]] = [
    ("source: scene:lane_drop", "sorce: scene:lane_drop", "line 9, key 'cameras[1].sorce'",
     "'source'?"),
    ("source: scene:lane_drop", "source: bag:x", "key 'cameras[1].calibration'", "control points"),
    ("enabled: true", "enabled: perhaps", "line 10", "perhaps"),
    ("43.25", "143.25", "line 12", "90"),
    ("43.25", "1,000", "line 12", "'1,000'"),
    ("enabled: true", "parameters: {trakcer: {}}", "line 10", "'tracker'?"),
    ("enabled: true", "parameters: {tracker: {max_agee: 3}}", "line 10", "max_age"),
    ("enabled: true", "parameters: {homography: {max_sigma_m: wide}}", "line 10", "a number"),
    ("id: south", "id: north", "line 8, key 'cameras[1].id'", "another id"),
    ("id: south", "id: viewer", "line 8, key 'cameras[1].id'", "a name that no service has"),
    ("id: south", "id: server", "line 8, key 'cameras[1].id'", "a name that no service has"),
    ("    datum:\n      latitude_deg: 43.25\n", "    datum: {latitude_deg: 43,25}\n    position:\n",
     "line 11", "in braces a comma separates"),
    ("id: south", "- south", "", ""),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "place", "expected"), LEFT_OUT)
def test_a_camera_that_cant_be_used_does_not_stop_the_others(
    tmp_path: Path, old: str, new: str, place: str, expected: str
) -> None:
    assert old in GOOD
    content = GOOD.replace(old, new, 1)
    if new == "- south":  # no mapping at all
        content = re.sub(r"  - id: south\n(    .*\n)+", "  - south\n", GOOD)
    fleet, told = read(tmp_path, content)
    assert [camera.id for camera in fleet.cameras] == ["north", "east"]
    assert told.startswith("1 of 3 cameras left out: ")
    assert place in told
    assert expected in told


@pytest.mark.parametrize(
    ("old", "new", "gone"),
    [
        ("network: roads", "netwrok: roads", "twin"),
        ("{port: 8765}", "{port: 0}", "viewer"),
        ("{folder: databases}", "{days: 3}", "recorder"),
        ("recorder: {", "carla: {opendrive: a.xodr, port: 99999}\nrecorder: {", "carla"),
        ("twin: {network: roads.net.xml}", "carla: {opendrive: a.xodr}", "carla"),
    ],
)
def test_a_service_that_cant_be_used_does_not_stop_the_cameras(
    tmp_path: Path, old: str, new: str, gone: str
) -> None:
    fleet, told = read(tmp_path, GOOD.replace(old, new, 1))
    assert len(fleet.cameras) == 3
    assert getattr(fleet, gone) is None
    assert f"{gone} is left out" in told


REFUSED = [
    ("", "an empty file"),
    ("# only a comment\n", "an empty file"),
    ("- id: north\n", "found a list, expected a fleet file in YAML: keys with values"),
    ("crossing\n", "a text without keys"),
    ("name: a\n" + GOOD, "line 2: found key 'name' a second time, first in line 1"),
    (GOOD + "cameras: []\n", r"found key 'cameras' a second time, first in line 2"),
    (GOOD.replace("    enabled", "\t enabled"), "found a tab in the indentation"),
    ("name: a\ncameras:\n", "cameras"),
    ("name: a\n", "line 1, key 'cameras'"),
    ("name: a\ncameras: [{id: a}]\n", "no camera that can be used .a: .*key 'cameras.0..source'"),
    ("name: a\ncameras: 3\n", "a list"),
    ("name: [\n", "broken YAML"),
    ("name: a\ncameras: !!int abc\n", "'abc' is no int"),
    ("name: a\ndomain_id: !!int 0xZZ\n", "'0xZZ' is no int"),
    ("name: a\ndomain_id: " + "9" * 5000 + "\n", "is no int"),
    ("name: a\ndomain_id: !!float north\n", "'north' is no float"),
    ("name: a\nenabled: !!bool maybe\n", "'maybe' is no bool"),
    ("name: a\nenabled: !!timestamp soon\n", "'soon' is no timestamp"),
    ("name: a\n? [a, b]\n: c\n", "a list or keys as a key"),
    ("name: a\nx: {? {a: 1} : 2}\n", "a list or keys as a key"),
    ("name: a\ncameras: " + "[" * 3000 + "]" * 3000 + "\n", "lists in lists"),
    ("\0\0\0", "broken YAML"),
]


@pytest.mark.parametrize(("content", "sentence"), REFUSED)
def test_what_is_no_fleet_at_all_is_refused_in_one_sentence(
    tmp_path: Path, content: str, sentence: str
) -> None:
    with pytest.raises(InputFileError, match=sentence) as caught:
        read(tmp_path, content)
    assert str(caught.value).isprintable()
    assert str(tmp_path / "fleet.yaml") in str(caught.value)


def test_a_text_in_another_encoding_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputFileError, match="no text in utf-8"):
        read(tmp_path, "name: a\ndescription: Straße\n".encode("latin-1"))


def test_paths_may_begin_at_home_or_with_a_variable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("SITE", "crossing4")
    content = GOOD.replace("source: scene:lane_drop", "source: bag:~/$SITE/bag") + (
        "federated_server: {}\n"
    )
    content = content.replace("enabled: true", "calibration: ${SITE}/$ABSENT.csv")
    content = content.replace("roads.net.xml", "~/roads.net.xml")
    fleet, _ = read(tmp_path, content)
    assert fleet.cameras[1].source == f"bag:{tmp_path}/home/crossing4/bag"
    assert fleet.cameras[1].calibration == Path("crossing4/$ABSENT.csv")
    assert fleet.twin is not None
    assert fleet.twin.network == tmp_path / "home" / "roads.net.xml"
    report = InputReport("fleet.yaml", "cameras", 3)
    left = leave_out_missing(fleet, tmp_path, report)
    assert [camera.id for camera in left.cameras] == ["north", "east"]
    assert left.twin is None
    told = " ".join(report.sentences())
    assert f"south: no {tmp_path}/crossing4/$ABSENT.csv, no {tmp_path}/home/crossing4/bag" in told
    assert "twin is left out: no " in told


def test_addresses_keep_their_dollars(tmp_path: Path) -> None:
    stream = "rtsp://user:pa$HOME~@camera/1"
    content = GOOD.replace("source: scene:lane_drop", f"source: '{stream}'")
    content = content.replace("enabled: true", "image_size: [640, 360]\n    calibration: a.csv")
    assert read(tmp_path, content)[0].cameras[1].source == stream


# --- up ---


def up(tmp_path: Path, *more: str) -> int:
    words = ["up", str(tmp_path / "fleet.yaml"), "--out", str(tmp_path / "out"), "--dry-run"]
    return main([*words, *more])


def test_up_starts_the_other_cameras_and_ends_with_a_status(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = GOOD.replace("twin: {network: roads.net.xml}\n", "")
    (tmp_path / "fleet.yaml").write_text(content.replace("enabled: true", "modle: yolo.onnx"))
    assert up(tmp_path) == 2
    shown = " ".join(capsys.readouterr().out.split())
    assert "1 of 3 cameras left out: south: " in shown
    assert "expected 'model'?" in shown
    assert " north " in shown
    assert " east " in shown
    assert up(tmp_path, "--strict") == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "not accepted with --strict" in error


def test_up_refuses_a_fleet_of_which_most_cameras_cant_be_used(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = GOOD.replace("scene:lane_drop", "gone.mp4").replace("scene:s_curve", "lost.mp4", 1)
    content = content.replace("source: ", "calibration: gone.csv\n    source: ")
    (tmp_path / "fleet.yaml").write_text(content)
    assert up(tmp_path) == 2
    said = capsys.readouterr()
    assert "a fleet of which most cameras can be used" in said.err
    shown = "".join((said.err + said.out).split())  # long paths are broken over lines
    assert "lost.mp4" in shown
    assert "gone.mp4" in shown


def test_a_bag_of_two_cameras_is_told_before_anything_starts(tmp_path: Path) -> None:
    box = np.zeros(5, PIXEL_TRACK_DTYPE)
    box["x"] = box["y"] = box["width"] = box["height"] = 50.0
    frames = Frames(np.arange(5, dtype=np.int64) * 10**8, np.arange(6), box)
    rows = [frames.frame(k) for k in range(5)]
    two = {1: ("/a/tracks_px", *TRACKS), 2: ("/b/tracks_px", *TRACKS)}
    messages = tables(frames.stamp_ns.tolist(), rows)
    both = messages + [(2, time_ns, data) for _, time_ns, data in messages]
    MadeMcap(two).write(tmp_path / "both.mcap", both)
    write_track_bag(tmp_path / "one", "other", frames)
    content = GOOD.replace("scene:lane_drop", "bag:both.mcap").replace("scene:s_curve", "bag:one")
    content = content.replace("    source", "    calibration: a.csv\n    source")
    fleet, _ = read(tmp_path, content)
    ids = {camera.id for camera in fleet.cameras}
    report = InputReport("fleet.yaml", "cameras", 3)
    left = ask_sources(fleet, tmp_path, tmp_path / "out", ids, report)
    assert [camera.id for camera in left.cameras] == ["north", "east"]
    assert "which has the cameras a, b: found south" in " ".join(report.sentences())
    fleet, _ = read(tmp_path, content.replace("id: south", "id: b"))
    assert len(ask_sources(fleet, tmp_path, tmp_path / "out", {"b"}).cameras) == 3
    chosen = "parameters: {bag_player: {topics: /a/tracks_px}}"
    fleet, _ = read(tmp_path, content.replace("enabled: true", chosen))
    assert len(ask_sources(fleet, tmp_path, tmp_path / "out", {"south"}).cameras) == 3


# --- parameters ---

DEFAULTS: dict[str, Value] = {"double": 0.0, "int": 0, "bool": True, "string": ""}


@pytest.mark.parametrize(
    ("kind", "given", "meant"),
    [
        ("double", "10", 10.0), ("double", " 0.5 ", 0.5), ("double", "10,5", 10.5),
        ("double", "1e3", 1000.0), ("double", 3, 3.0), ("int", "10", 10), ("int", 10.0, 10),
        ("int", "-3", -3), ("bool", "yes", True), ("bool", "Off", False), ("bool", "on", True),
        ("bool", "false", False), ("string", 12, "12"), ("string", 1.5, "1.5"),
        ("string", "yes", "yes"),
    ],
)  # fmt: skip
def test_a_parameter_that_can_mean_one_thing_is_taken_for_it(
    kind: str, given: object, meant: object
) -> None:
    spec = ParameterSpec("p", kind, DEFAULTS[kind], "")
    checked = spec.checked(given, "node")
    assert checked == meant
    assert type(checked) is type(meant)


@pytest.mark.parametrize(
    ("kind", "given"),
    [
        ("double", "ten"), ("double", "1,000"), ("double", "1,2,3"), ("double", ""), ("int", 1.5),
        ("int", "1.5"), ("int", "0x"), ("bool", "maybe"), ("bool", 2), ("string", True),
        ("int", True), ("double", None), ("double", "nan"), ("double", "inf"),
    ],
)  # fmt: skip
def test_a_parameter_that_means_nothing_is_refused_as_it_is_written(
    kind: str, given: object
) -> None:
    spec = ParameterSpec("p", kind, DEFAULTS[kind], "")
    if given == "inf":
        spec = ParameterSpec("p", "double", 0.0, "", bounds=(0.0, 10.0))
    with pytest.raises(ParameterError) as caught:
        spec.checked(given, "node")
    assert str(given) in str(caught.value)


def test_scenes_are_read_by_the_same_rules(tmp_path: Path) -> None:
    file = tmp_path / "scene.yaml"
    for content, sentence in (
        ("", "an empty file"),
        ("- a\n", "a list"),
        ("a: 1\na: 2\n", "twice|second"),
    ):
        file.write_text(content)
        with pytest.raises(InputFileError, match=sentence):
            read_yaml(file, Scene, "scene")
