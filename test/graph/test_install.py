"""Both installers put every file where ROS 2 looks for it; every installed executable starts."""

import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
SOURCES = ("geoorbit_ros", "resource", "scripts", "launch", "params", "msg_defs", "bags")
NODES = sorted(path.name for path in (REPOSITORY / "scripts").iterdir())
PYTHON = f"python{sys.version_info.major}.{sys.version_info.minor}"
LIMIT_S = 120


def clean_environment() -> dict[str, str]:
    """What a user's shell would have: nothing that the ROS wheels set in this process."""
    environment = dict(os.environ)
    for name in ("LD_LIBRARY_PATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE", "PYTHONPATH"):
        environment.pop(name, None)
    return environment


def run(*command: str | Path, cwd: Path) -> str:
    done = subprocess.run(
        [str(word) for word in command],
        cwd=cwd,
        env=clean_environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=LIMIT_S,
    )
    assert done.returncode == 0, done.stdout
    return done.stdout


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the sources, as a clone has them: builds leave files beside what they build."""
    target = tmp_path_factory.mktemp("workspace") / "src" / "geoorbit_ros"
    target.mkdir(parents=True)
    for path in REPOSITORY.iterdir():
        if path.is_dir() and path.name in SOURCES:
            ignore = shutil.ignore_patterns("__pycache__")
            shutil.copytree(path, target / path.name, ignore=ignore)
        elif path.is_file():
            shutil.copy2(path, target)
    return target


@pytest.fixture(scope="module")
def pip_prefix(checkout: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fresh virtual environment with the package installed by pip.

    The dependencies are those of this environment, through a path file: nothing is downloaded.
    """
    prefix = tmp_path_factory.mktemp("pip") / "a venv"
    run(sys.executable, "-m", "venv", "--without-pip", prefix, cwd=checkout)
    site_packages = prefix / "lib" / PYTHON / "site-packages"
    (site_packages / "dependencies.pth").write_text(
        f"import site; site.addsitedir({sysconfig.get_path('purelib')!r})\n"
    )
    run(
        *(sys.executable, "-m", "pip", "--python", prefix / "bin" / "python3", "install"),
        *("--no-deps", "--no-build-isolation", "--no-index", "--quiet", "."),
        cwd=checkout,
    )
    return prefix


@pytest.fixture(scope="module")
def colcon_prefix(checkout: Path) -> Path:
    """`colcon build` of a workspace, without a sourced ROS installation."""
    workspace = checkout.parents[1]
    run(*colcon(), "build", cwd=workspace)
    return workspace / "install" / "geoorbit_ros"


@pytest.fixture(scope="module")
def colcon_symlink_prefix(checkout: Path) -> Path:
    """`colcon build --symlink-install`: the developer's way."""
    workspace = checkout.parents[1]
    bases = ("--build-base", "build_linked", "--install-base", "install_linked")
    run(*colcon(), "build", "--symlink-install", *bases, cwd=workspace)
    return workspace / "install_linked" / "geoorbit_ros"


def colcon() -> tuple[str, ...]:
    pytest.importorskip("colcon_core", reason="colcon is in requirements/dev.txt")
    return (sys.executable, "-c", "import sys, colcon_core.command as c; sys.exit(c.main())")


PREFIXES = pytest.mark.parametrize(
    "prefix_fixture", ["pip_prefix", "colcon_prefix", "colcon_symlink_prefix"]
)


def test_colcon_recognises_a_ros_package(checkout: Path) -> None:
    listed = run(*colcon(), "list", cwd=checkout.parents[1])
    assert listed.split() == ["geoorbit_ros", "src/geoorbit_ros", "(ros.ament_python)"]


@PREFIXES
def test_files_are_where_ros_2_looks(prefix_fixture: str, request: pytest.FixtureRequest) -> None:
    prefix: Path = request.getfixturevalue(prefix_fixture)
    assert (prefix / "share/ament_index/resource_index/packages/geoorbit_ros").is_file()
    executables = sorted((prefix / "lib" / "geoorbit_ros").iterdir())
    assert [path.name for path in executables] == NODES
    assert [oct(path.stat().st_mode & 0o777) for path in executables] == ["0o755"] * len(NODES)
    assert os.access(prefix / "bin" / "geoorbit", os.X_OK)


@PREFIXES
def test_shared_files_are_complete(
    prefix_fixture: str, request: pytest.FixtureRequest, checkout: Path
) -> None:
    prefix: Path = request.getfixturevalue(prefix_fixture)
    shared = prefix / "share" / "geoorbit_ros"
    expected = {
        path.relative_to(checkout)
        for folder in ("launch", "params", "msg_defs", "bags")
        for path in (checkout / folder).rglob("*")
        if path.is_file()
    } | {Path("package.xml")}
    missing = {path for path in expected if not (shared / path).is_file()}
    assert not missing
