"""The package says the same thing everywhere: executables, metadata, requirements."""

import ast
import configparser
import os
import re
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

import geoorbit_ros

REPOSITORY = Path(__file__).parents[2]
SOURCES = sorted((REPOSITORY / "geoorbit_ros").rglob("*.py"))
REQUIREMENTS = REPOSITORY / "requirements"

# Imported name → distribution on the package index, where they differ.
DISTRIBUTIONS = {
    "cv2": "opencv-python-headless",
    "foxglove": "foxglove-sdk",
    "sklearn": "scikit-learn",
    "sumo": "eclipse-sumo",
    "yaml": "pyyaml",
    "rclpy": "ros-rclpy",
}
# Optional imports: present with a ROS installation, not on the package index.
ROS_ONLY = {"ament_index_python", "launch", "launch_ros"}


def setup_cfg() -> configparser.ConfigParser:
    parser = configparser.ConfigParser()
    parser.read(REPOSITORY / "setup.cfg")
    return parser


def pinned(file: str) -> dict[str, str]:
    """Distribution → version of a requirements file; fails on anything that is not exact."""
    found = {}
    for line in (REQUIREMENTS / file).read_text().splitlines():
        requirement = line.partition("#")[0].partition(";")[0].strip()
        if requirement and not requirement.startswith("-r "):
            match = re.fullmatch(r"([\w.-]+)(?:\[\w+\])?==([\w.]+)", requirement)
            assert match, f"{file}: found {line!r}, expected NAME==VERSION"
            found[re.sub(r"[-_.]+", "-", match[1]).lower()] = match[2]
    return found


def top_level_imports() -> set[str]:
    found = set()
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                found |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                found.add(node.module.partition(".")[0])
    return found - set(sys.stdlib_module_names) - {"geoorbit_ros"}


def node_modules() -> set[str]:
    """Files of `nodes/`, and folders with a `node.py`, that define `main`: one executable each."""
    folder = REPOSITORY / "geoorbit_ros" / "nodes"
    return {
        path.parent.name if path.name == "node.py" else path.stem
        for path in (*folder.glob("*.py"), *folder.glob("*/node.py"))
        if any(
            isinstance(statement, ast.FunctionDef) and statement.name == "main"
            for statement in ast.parse(path.read_text(encoding="utf-8")).body
        )
    }


def test_every_node_has_an_executable_and_every_executable_a_node() -> None:
    executables = {path.name for path in (REPOSITORY / "scripts").iterdir()}
    assert executables == node_modules()


def test_executables_are_the_same_file_and_executable() -> None:
    paths = sorted((REPOSITORY / "scripts").iterdir())
    assert len({path.read_bytes() for path in paths}) == 1
    assert [path.name for path in paths if not os.access(path, os.X_OK)] == []
    assert paths[0].read_text().startswith("#!/usr/bin/env python3\n")


def test_one_version_everywhere() -> None:
    package_xml = ET.parse(REPOSITORY / "package.xml").getroot()
    versions = {
        "setup.cfg": setup_cfg()["metadata"]["version"],
        "package.xml": package_xml.findtext("version"),
        "geoorbit_ros": geoorbit_ros.__version__,
    }
    assert len(set(versions.values())) == 1, versions


def test_package_xml_declares_an_ament_python_package() -> None:
    package = ET.parse(REPOSITORY / "package.xml").getroot()
    assert package.get("format") == "3"
    assert package.findtext("name") == setup_cfg()["metadata"]["name"]
    assert package.findtext("export/build_type") == "ament_python"


def test_package_xml_names_every_imported_ros_package() -> None:
    package = ET.parse(REPOSITORY / "package.xml").getroot()
    declared = {element.text for element in package.findall("exec_depend")}
    ros = {n for n in top_level_imports() if re.fullmatch(r"rclpy|\w+_(msgs|srvs|interfaces)", n)}
    assert ros <= declared


def test_every_third_party_import_is_a_declared_requirement() -> None:
    runtime = pinned("runtime.txt")
    messages = {n for n in top_level_imports() if re.fullmatch(r"\w+_(msgs|srvs|interfaces)", n)}
    needed = {
        DISTRIBUTIONS.get(name, name).replace("_", "-").lower()
        for name in top_level_imports() - messages - ROS_ONLY
    }
    assert needed <= {*runtime, *pinned("torch.txt")}, (
        "add it to requirements/runtime.txt, setup.cfg and ADR 0002"
    )


def test_setup_cfg_requires_what_runtime_txt_pins() -> None:
    configuration = setup_cfg()
    extras = " ".join(configuration["options.extras_require"].values())
    lines = (configuration["options"]["install_requires"] + extras).split()
    names = {re.split(r"[\[<>=]", line)[0].lower() for line in lines}
    assert names == {*pinned("runtime.txt"), "torch"}


def test_the_lock_agrees_with_what_pytorch_needs() -> None:
    torch, lock = pinned("torch.txt"), pinned("lock.txt")
    assert {name: lock[name] for name in torch if name in lock}.items() <= torch.items()


@pytest.mark.parametrize("file", ["runtime.txt", "dev.txt"])
def test_the_lock_agrees_with_the_direct_requirements(file: str) -> None:
    direct, lock = pinned(file), pinned("lock.txt")
    assert {name: lock.get(name) for name in direct} == direct


def test_requirements_name_no_registry() -> None:
    for path in REQUIREMENTS.iterdir():
        assert not re.search(
            r"https?://|file:|--(extra-)?index|--find-links|--hash", path.read_text()
        )


def test_licences_and_reasons_are_written_down_for_every_requirement() -> None:
    record = (REPOSITORY / "docs" / "adr" / "0002-dependencies.md").read_text().lower()
    missing = {
        name for name in pinned("runtime.txt") | pinned("dev.txt") if f"`{name}`" not in record
    }
    assert not missing


def test_the_index_lists_every_decision_record() -> None:
    folder = REPOSITORY / "docs" / "adr"
    records = {path.name for path in folder.glob("[0-9]*.md")}
    listed = re.findall(r"\]\((\d{4}-[\w-]+\.md)\)", (folder / "README.md").read_text())
    assert sorted(listed) == sorted(records)


def test_the_files_that_quick_leaves_out_exist() -> None:
    text = (REPOSITORY / "test" / "conftest.py").read_text()
    match = re.search(r"LONG = \[(.*?)\]", text, re.DOTALL)
    assert match is not None
    names = {path.name for path in (REPOSITORY / "test" / "unit").rglob("test_*.py")}
    assert {f"test_{name}.py" for name in re.findall(r'"(\w+)"', match[1])} <= names
