"""A camera is added to a fleet file; everything else in the file stays as it was."""

from pathlib import Path

import pytest

from geoorbit_ros.core.errors import InputFileError, ParameterError
from geoorbit_ros.fleet.fleet_io import (
    add_camera,
    check_new_camera,
    datum_of,
    relative,
    remove_camera,
)

ENTRY = {"id": "north", "source": "scene:lane_drop", "image_size": [640, 360]}

FILES = {
    "comments": "name: a\ncameras:\n  # one\n  - id: one\n    source: scene:s_curve # it\n"
    "  # after it\n\nrecorder: {}  # keep\n",
    "cameras last": "name: a\nrecorder: {}\ncameras:\n  - {id: one, source: 'scene:s_curve'}",
    "no indent": "name: a\ncameras:\n- id: one\n  source: scene:s_curve\nrecorder: {}\n",
    "nested": "name: a\ncameras:\n  - id: one\n    source: scene:s_curve\n    parameters:\n"
    "      lane_geometry: {update_period_s: 2}\n\n\nviewer: {port: 1234}\n",
}


@pytest.mark.parametrize("text", FILES.values(), ids=FILES)
def test_the_new_camera_comes_last_and_every_line_stays(tmp_path: Path, text: str) -> None:
    file = tmp_path / "fleet.yaml"
    file.write_text(text)
    fleet = add_camera(file, ENTRY)
    assert [camera.id for camera in fleet.cameras] == ["one", "north"]
    assert fleet.cameras[1].image_size == (640, 360)
    lines = iter(file.read_text().splitlines())
    assert all(line in lines for line in text.splitlines()), "in their order"


@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("motorway.yaml", "motorway"),
        ("my-fleet.yaml", "my_fleet"),
        ("12 north.yaml", "fleet_12_north"),
    ],
)
def test_a_missing_file_is_made_and_names_the_fleet(tmp_path: Path, file: str, name: str) -> None:
    fleet = add_camera(tmp_path / file, ENTRY)
    assert (fleet.name, [camera.id for camera in fleet.cameras]) == (name, ["north"])


@pytest.mark.parametrize("camera_id", ["no-name", "1st", "", "north east", "é"])
def test_an_id_that_ros_does_not_take_is_refused_before_any_work(
    tmp_path: Path, camera_id: str
) -> None:
    with pytest.raises(ParameterError, match="--camera-id"):
        check_new_camera(tmp_path / "fleet.yaml", camera_id)


def test_a_camera_that_is_there_already_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "fleet.yaml"
    add_camera(file, ENTRY)
    before = file.read_text()
    with pytest.raises(InputFileError, match="'north' is there already"):
        add_camera(file, ENTRY)
    assert file.read_text() == before


def test_a_wrong_entry_leaves_the_file_as_it_was(tmp_path: Path) -> None:
    file = tmp_path / "fleet.yaml"
    file.write_text(FILES["comments"])
    with pytest.raises(InputFileError, match="nowhere"):
        add_camera(file, {**ENTRY, "source": "scene:nowhere", "nowhere": 1})
    assert file.read_text() == FILES["comments"]
    assert list(tmp_path.iterdir()) == [file]


def test_a_list_in_brackets_is_left_alone(tmp_path: Path) -> None:
    file = tmp_path / "fleet.yaml"
    text = "name: a\ncameras: [{id: one, source: 'scene:s_curve'}]\n"
    file.write_text(text)
    with pytest.raises(InputFileError, match="brackets"):
        add_camera(file, ENTRY)
    assert file.read_text() == text


def test_paths_are_named_from_the_files_folder(tmp_path: Path) -> None:
    video = tmp_path / "videos" / "north.mp4"
    assert relative(video, tmp_path / "fleets" / "fleet.yaml") == "../videos/north.mp4"


@pytest.mark.parametrize("text", FILES.values(), ids=FILES)
def test_a_camera_taken_out_again_leaves_the_file_as_it_was(tmp_path: Path, text: str) -> None:
    file = tmp_path / "fleet.yaml"
    file.write_text(text)
    add_camera(file, ENTRY)
    assert [camera.id for camera in remove_camera(file, "north").cameras] == ["one"]
    assert file.read_text() == text.rstrip("\n") + "\n"


@pytest.mark.parametrize("text", FILES.values(), ids=FILES)
def test_a_camera_replaced_keeps_its_place_and_the_lines_of_the_others(
    tmp_path: Path, text: str
) -> None:
    file = tmp_path / "fleet.yaml"
    file.write_text(text)
    add_camera(file, ENTRY)
    once = file.read_text()
    fleet = add_camera(file, {"id": "one", "source": "scene:urban_turn"}, replace=True)
    assert [(camera.id, camera.source) for camera in fleet.cameras] == [
        ("one", "scene:urban_turn"),
        ("north", "scene:lane_drop"),
    ]
    north = [line for line in once.splitlines() if "north" in line or "lane_drop" in line]
    assert all(line in file.read_text().splitlines() for line in north)
    assert "s_curve" not in file.read_text()


BY_HAND = """\
name: road
cameras:
  # the bridge
  - id: one  # the first
    model: old.onnx
    # the film of May
    source: scene:s_curve
    parameters:
      tracker: {max_gap_s: 2.0}  # cars stop here
    enabled: false
    datum: {latitude_deg: 43.0, longitude_deg: -89.0}

  # the next one
  - id: two
    source: scene:lane_drop
"""


ID_LATER = BY_HAND.replace(
    "  - id: one  # the first\n    model: old.onnx\n", "  -   model: old.onnx\n"
)
ID_LATER = ID_LATER.replace("\n    ", "\n      ").replace("s_curve\n", "s_curve\n      id: one\n")
ID_LATER = ID_LATER.replace("id: two\n  ", "id: two\n")


@pytest.mark.parametrize("text", [BY_HAND, ID_LATER])
def test_what_was_set_by_hand_stays_when_a_camera_is_replaced(tmp_path: Path, text: str) -> None:
    file = tmp_path / "fleet.yaml"
    file.write_text(text)
    (tmp_path / "old.onnx").touch()
    new = {"id": "one", "source": "scene:urban_turn", "image_size": [640, 360]}
    fleet = add_camera(file, new, replace=True)
    camera = fleet.cameras[0]
    assert (camera.source, camera.image_size) == ("scene:urban_turn", (640, 360))
    assert camera.parameters == {"tracker": {"max_gap_s": 2.0}}
    assert not camera.enabled
    assert camera.model is None
    comments = [line.partition("#")[2] for line in text.splitlines() if "#" in line]
    assert [c for c in comments if f"#{c}" not in file.read_text()] == []
    assert [c.id for c in fleet.cameras] == ["one", "two"]


HAND_WRITTEN = {
    "an anchor beside the dash": "- &one\n    id: one\n    source: scene:s_curve\n"
    "    enabled: false\n",
    "a dash on its own line": "-\n    id: one\n    source: scene:s_curve  # q\n"
    "    enabled: false\n",
    "keys below keys at the end": "- id: one\n    source: scene:s_curve\n    enabled: false\n"
    "    datum:\n      latitude_deg: 43.0\n      longitude_deg: -89.0\n",
    "an alias in braces": "- {id: one, source: 'scene:s_curve', parameters: *p, enabled: false}\n",
    "an alias in a block": "- id: one\n    source: scene:s_curve\n    enabled: false\n"
    "    parameters: *p\n",
}


@pytest.mark.parametrize("item", HAND_WRITTEN.values(), ids=HAND_WRITTEN)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_any_spelling_of_a_camera_is_replaced_and_taken_out(
    tmp_path: Path, item: str, encoding: str, end: str
) -> None:
    file = tmp_path / "fleet.yaml"
    head = "name: a\nx-common: &p\n  tracker: {max_gap_s: 2.0}\ncameras:\n"
    text = f"{head}  {item}  - id: two\n    source: scene:lane_drop\n"
    file.write_bytes(text.replace("\n", end).encode(encoding))
    fleet = add_camera(file, {"id": "one", "source": "scene:urban_turn"}, replace=True)
    assert [c.source for c in fleet.cameras] == ["scene:urban_turn", "scene:lane_drop"]
    assert not fleet.cameras[0].enabled
    assert bool(fleet.cameras[0].parameters) == ("*p" in item)
    assert ("# q" in file.read_bytes().decode()) == ("# q" in item)
    assert file.read_bytes().count(b"\r\n") == (
        file.read_bytes().count(b"\n") if end != "\n" else 0
    )
    assert [c.id for c in remove_camera(file, "one").cameras] == ["two"]
    assert "one" not in file.read_text()


def test_the_last_key_of_a_file_may_have_keys_and_its_comments_stay_where_they_are(
    tmp_path: Path,
) -> None:
    file = tmp_path / "fleet.yaml"
    file.write_text(
        "name: a\ncameras:\n  - id: one\n    datum:\n      latitude_deg: 43.0\n"
        "      longitude_deg: -89.0\n    source: scene:s_curve  # the film\n"
    )
    place = {"latitude_deg": 44.0, "longitude_deg": -88.0}
    add_camera(file, {"id": "one", "source": "scene:s_curve", "datum": place}, replace=True)
    assert file.read_text().count("# the film") == 1
    assert "source: scene:s_curve  # the film" in file.read_text()
    file.write_text(
        "name: a\ncameras:\n  - id: one\n    source: scene:s_curve\n    datum:\n"
        "      latitude_deg: 43.0\n      longitude_deg: -89.0"
    )
    fleet = add_camera(file, {"id": "one", "source": "scene:s_curve", "datum": place}, replace=True)
    assert fleet.cameras[0].datum is not None
    assert fleet.cameras[0].datum.latitude_deg == 44.0


def test_a_camera_that_another_one_uses_is_not_taken_out(tmp_path: Path) -> None:
    file = tmp_path / "fleet.yaml"
    text = (
        "name: a\ncameras:\n  - id: one\n    source: &s scene:s_curve\n"
        "  - id: two\n    source: *s\n"
    )
    file.write_text(text)
    with pytest.raises(InputFileError) as caught:
        remove_camera(file, "one")
    assert str(file) in str(caught.value)
    assert str(tmp_path / ".") not in str(caught.value).replace(str(file), "")
    assert file.read_text() == text


def test_the_origin_of_a_camera_is_read_from_the_file(tmp_path: Path) -> None:
    file = tmp_path / "fleet.yaml"
    assert datum_of(file, "one") is None
    file.write_text(BY_HAND.replace("    model: old.onnx\n", ""))
    place = datum_of(file, "one")
    assert place is not None
    assert (place.latitude_deg, place.longitude_deg) == (43.0, -89.0)
    assert datum_of(file, "two") is None


def test_replacing_a_camera_that_is_not_there_adds_it(tmp_path: Path) -> None:
    file = tmp_path / "fleet.yaml"
    assert [camera.id for camera in add_camera(file, ENTRY, replace=True).cameras] == ["north"]


def test_what_can_not_be_taken_out_is_said(tmp_path: Path) -> None:
    file = tmp_path / "fleet.yaml"
    add_camera(file, ENTRY)
    before = file.read_text()
    with pytest.raises(InputFileError, match="no camera 'south', expected one of north"):
        remove_camera(file, "south")
    with pytest.raises(InputFileError, match="only camera 'north'"):
        remove_camera(file, "north")
    assert file.read_text() == before
