"""Files that ROS 2 looks for outside the Python package; everything else is in setup.cfg.

pip and colcon both honour ``data_files``. Neither needs a ``[install] install_scripts`` setting,
which pip ignores: the executables of ``ros2 run`` are plain files in ``scripts/``.
"""

from pathlib import Path

from setuptools import setup

PACKAGE = "geoorbit_ros"
SHARE = f"share/{PACKAGE}"
SHARED_FOLDERS = ("launch", "params", "msg_defs", "bags")


def folder(source: str, target: Path) -> list[tuple[str, list[str]]]:
    """List the files of a folder and its subfolders, each with the folder it is installed in."""
    entries: dict[str, list[str]] = {}
    for path in sorted(Path(source).rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts:
            place = target / path.parent.relative_to(source)
            entries.setdefault(str(place), []).append(str(path))
    return list(entries.items())


setup(
    # Not in setup.cfg: there it becomes an object that colcon cannot read back.
    python_requires=">=3.11,<3.13",
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (SHARE, ["package.xml"]),
        *folder("scripts", Path(f"lib/{PACKAGE}")),
        *(entry for name in SHARED_FOLDERS for entry in folder(name, Path(SHARE) / name)),
    ],
)
