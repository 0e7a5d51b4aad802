"""Both installers put every file where ROS 2 looks for it; every installed executable starts."""

import os
import shutil
import signal
import subprocess
import sys
import sysconfig
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
import rclpy
from rclpy.context import Context
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.tables import PIXEL_TRACK_DTYPE, Frames, frames_from_rows
from geoorbit_ros.nodes.support.composition import DomainClaim
from geoorbit_ros.scenes.network import write_network
from geoorbit_ros.scenes.roads import place_roads
from geoorbit_ros.scenes.scene import load_scene
from geoorbit_ros.storage.track_bag import write_track_bag

pytestmark = pytest.mark.slow

REPOSITORY = Path(__file__).parents[2]
SOURCES = ("geoorbit_ros", "resource", "scripts", "launch", "params", "msg_defs", "bags")
NODES = sorted(path.name for path in (REPOSITORY / "scripts").iterdir())
SERVERLESS = [name for name in NODES if name != "carla_bridge"]
"""The CARLA bridge ends where no server answers (test_carla_bridge_node)."""
PYTHON = f"python{sys.version_info.major}.{sys.version_info.minor}"
LIMIT_S = 240

CONTROL_POINTS = """\
pixel_x,pixel_y,latitude,longitude
200,900,43.00000,-89.00000
1700,900,43.00000,-88.99980
600,400,43.00100,-89.00000
1300,400,43.00100,-88.99980
950,600,43.00040,-88.99990
"""


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


@pytest.fixture(scope="module")
def node_parameters(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, str]]:
    """What each node needs to come up and wait for work."""
    folder = tmp_path_factory.mktemp("input")
    (folder / "calibration.csv").write_text(CONTROL_POINTS)
    write_track_bag(folder / "bag", "pole", two_frames())
    (folder / "images").mkdir()
    cv2.imwrite(str(folder / "images" / "0.png"), np.zeros((48, 64, 3), np.uint8))
    (folder / "roster.txt").write_text("pole unsigned\n")
    scene = load_scene("s_curve")
    place = Datum(scene.place.latitude_deg, scene.place.longitude_deg)
    network = write_network(place_roads(scene), folder, place)
    return {
        "bag_player": {"bag": f"{folder}/bag", "start_paused": "true", "wait_timeout_s": "0.0"},
        "camera": {"source": f"{folder}/images", "fps": "1.0", "exit_when_done": "false"},
        "federated_server": {"roster": f"{folder}/roster.txt"},
        "homography": {"calibration_file": f"{folder}/calibration.csv"},
        "sumo_bridge": {"network": str(network), "cameras": "pole"},
        "viewer": {"port": "0"},
        "recorder": {"database": f"{folder}/tracks.db", "camera_id": "pole"},
    }


def two_frames() -> Frames:
    rows = np.zeros(2, PIXEL_TRACK_DTYPE)
    return frames_from_rows(np.array([10**9, 2 * 10**9]), rows)


@dataclass(frozen=True)
class Observer:
    """A node of this process that sees who else is in the graph.

    Each test has a domain of its own: nodes that have just ended stay in the graph for a while.
    """

    domain_id: int
    node: Node
    executor: Executor

    def names_after(self, timeout_s: float) -> set[str]:
        """Names of all nodes, after whatever comes in within `timeout_s` was handled."""
        self.executor.spin_once(timeout_sec=timeout_s)
        return set(self.node.get_node_names())


@pytest.fixture
def observer() -> Iterator[Observer]:
    context, claim = Context(), DomainClaim()
    rclpy.init(context=context, domain_id=claim.domain_id)
    node = Node("observer", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    yield Observer(claim.domain_id, node, executor)
    executor.shutdown()
    node.destroy_node()
    rclpy.shutdown(context=context)
    claim.close()


def as_pip_user(_prefix: Path, folder: Path) -> tuple[list[str], dict[str, str]]:
    """An environment that is not activated: `python3` is another one, without dependencies."""
    other = folder / "bin"
    other.mkdir()
    (other / "python3").symlink_to(Path(sys.base_prefix) / "bin" / PYTHON)
    # The ROS wheels look for libraries in their own prefix; the borrowed ones are in another.
    libraries = f"{sys.prefix}/lib:{os.environ.get('LD_LIBRARY_PATH', '')}"
    return [], {"PATH": f"{other}:/usr/bin:/bin", "LD_LIBRARY_PATH": libraries}


def as_colcon_user(prefix: Path, _folder: Path) -> tuple[list[str], dict[str, str]]:
    """A shell in which the workspace was sourced; `python3` is the one that has ROS."""
    source = 'source "$0" && exec "$@"'
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    return ["bash", "-c", source, str(prefix.parent / "setup.bash")], {"PATH": path}


@PREFIXES
def test_every_executable_starts_its_node_and_ends_on_sigint(
    prefix_fixture: str,
    request: pytest.FixtureRequest,
    node_parameters: dict[str, dict[str, str]],
    observer: Observer,
    tmp_path: Path,
) -> None:
    prefix: Path = request.getfixturevalue(prefix_fixture)
    user = as_pip_user if prefix_fixture == "pip_prefix" else as_colcon_user
    start, variables = user(prefix, tmp_path)
    environment = clean_environment() | variables | {"ROS_DOMAIN_ID": str(observer.domain_id)}
    processes = {}
    for name in SERVERLESS:
        words = [f"{key}:={value}" for key, value in node_parameters.get(name, {}).items()]
        options = [word for pair in words for word in ("-p", pair)]
        processes[name] = subprocess.Popen(
            [*start, str(prefix / "lib" / "geoorbit_ros" / name), "--ros-args", *options],
            cwd=tmp_path,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
    try:
        wait_until_up(observer, processes)
        # A Ctrl-C under `ros2 launch` comes from the terminal and from launch.
        for _ in range(2):
            for process in processes.values():
                process.send_signal(signal.SIGINT)
            observer.names_after(0.02)
        output = {
            name: process.communicate(timeout=LIMIT_S)[0] for name, process in processes.items()
        }
    finally:
        for process in processes.values():
            process.kill()
    statuses = {name: process.returncode for name, process in processes.items()}
    assert statuses == dict.fromkeys(SERVERLESS, 0), output
    assert not [name for name in SERVERLESS if "Traceback" in output[name]], output


def wait_until_up(observer: Observer, processes: dict[str, "subprocess.Popen[str]"]) -> None:
    """Spin until the graph shows a node for every process; fails when one ended or none came."""
    deadline = time.monotonic() + LIMIT_S
    while missing := set(processes) - observer.names_after(0.1):
        for name, process in processes.items():
            assert process.poll() is None, f"{name} ended: {process.communicate()[0]}"
        assert time.monotonic() < deadline, f"not in the graph after {LIMIT_S} s: {missing}"
