"""One camera: its lanes, live, from a video or from a bag; or a fleet of cameras from its file.

    ros2 launch geoorbit_ros geoorbit.launch.py camera_id:=north calibration:=calibration.csv \
        source:=rtsp://camera.example/stream rviz:=true
    ros2 launch geoorbit_ros geoorbit.launch.py camera_id:=north calibration:=calibration.csv \
        bag:=north_bag rate:=10 rviz:=true
    ros2 launch geoorbit_ros geoorbit.launch.py fleet:=fleet.yaml

Wiring only: every number is in the parameter schemas and in `params_file`.
"""

from pathlib import Path

from launch import Action, LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, LogInfo, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import (
    AndSubstitution,
    LaunchConfiguration,
    NotEqualsSubstitution,
    PathJoinSubstitution,
)
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.core.input_report import InputReport
from geoorbit_ros.fleet.fleet_io import load_fleet
from geoorbit_ros.fleet.prepare import leave_out_missing, prepare

PACKAGE = "geoorbit_ros"


def generate_launch_description() -> LaunchDescription:
    share = FindPackageShare(PACKAGE)
    arguments = [
        DeclareLaunchArgument(
            "fleet", default_value="", description="A fleet file; see geoorbit up."
        ),
        DeclareLaunchArgument("out", default_value="", description="The fleet's output folder."),
        DeclareLaunchArgument(
            "camera_id", default_value="", description="Namespace of the camera."
        ),
        DeclareLaunchArgument(
            "calibration", default_value="", description="Control points, a CSV file."
        ),
        DeclareLaunchArgument("source", default_value="", description="Video, address or images."),
        DeclareLaunchArgument("model", default_value="", description="YOLO model, an ONNX file."),
        DeclareLaunchArgument("bag", default_value="", description="Play this; empty: live."),
        DeclareLaunchArgument("rate", default_value="1.0", description="Speed of the bag."),
        DeclareLaunchArgument("database", default_value="", description="Record into this file."),
        DeclareLaunchArgument(
            "traffic", default_value="true", description="Count vehicles per lane; false: don't."
        ),
        DeclareLaunchArgument(
            "timezone", default_value="UTC", description="Of traffic intervals, Europe/Berlin."
        ),
        DeclareLaunchArgument(
            "watch_view", default_value="true", description="Notice when the camera is moved."
        ),
        DeclareLaunchArgument(
            "view_file", default_value="", description="Keep the reference view in this file."
        ),
        DeclareLaunchArgument("rviz", default_value="false", description="Show it in RViz."),
        DeclareLaunchArgument(
            "params_file",
            default_value=PathJoinSubstitution([share, "params", "one_camera.yaml"]),
            description="Parameters of the nodes.",
        ),
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=choose)])


def choose(context: LaunchContext) -> list[Action]:
    """The nodes of the fleet where one is named, else those of one camera."""
    fleet = LaunchConfiguration("fleet").perform(context)
    out = LaunchConfiguration("out").perform(context)
    if fleet:
        return fleet_nodes(fleet, out)
    names = ("camera_id", "calibration", "source", "bag")
    check_one_camera(*(LaunchConfiguration(name).perform(context) for name in names))
    return one_camera_nodes()


def check_one_camera(camera_id: str, calibration: str, source: str, bag: str) -> None:
    """Say what is missing before any node starts.

    Raises:
        ParameterError: An argument that one camera needs is empty, or names no file.
    """
    if not camera_id:
        raise ParameterError("launch argument 'camera_id'", "nothing", "a name such as north")
    if not Path(calibration).is_file():
        found = f"no file '{calibration}'" if calibration else "nothing"
        raise ParameterError("launch argument 'calibration'", found, "a CSV file of control points")
    if bool(source) == bool(bag):
        found = "both" if bag else "neither"
        raise ParameterError("launch arguments 'source', 'bag'", found, "one of them")
    if bag and not Path(bag).exists():
        raise ParameterError("launch argument 'bag'", f"no file '{bag}'", "a bag")


def fleet_nodes(fleet: str, out: str) -> list[Action]:
    """The graph that `geoorbit up` makes, one process per node, and what is left out of it."""
    report = InputReport(fleet, "cameras")
    content, file = load_fleet(fleet, report)
    content = leave_out_missing(content, file.parent.absolute(), report)
    base, output = file.parent.absolute(), (Path(out or f"out/{content.name}")).absolute()
    nodes = [
        Node(
            package=PACKAGE,
            executable=node.executable,
            namespace=node.namespace,
            parameters=[dict(node.parameters)],
            respawn=True,
            respawn_delay=1.0,
        )
        for plan in prepare(content, base, output, report=report)
        for node in plan.nodes
    ]
    return [*(LogInfo(msg=f"{fleet}: {text}") for text in report.sentences()), *nodes]


def one_camera_nodes() -> list[Node]:
    """The nodes of one camera, by the launch arguments."""
    share = FindPackageShare(PACKAGE)
    camera_id = LaunchConfiguration("camera_id")
    source = LaunchConfiguration("source")
    bag = LaunchConfiguration("bag")
    rate = LaunchConfiguration("rate")
    model = LaunchConfiguration("model")
    calibration = LaunchConfiguration("calibration")
    database = LaunchConfiguration("database")
    timezone = LaunchConfiguration("timezone")
    params_file = LaunchConfiguration("params_file")
    from_source = NotEqualsSubstitution(source, "")
    from_bag = NotEqualsSubstitution(bag, "")
    sim_time = {"use_sim_time": ParameterValue(from_bag, value_type=bool)}

    return [
        Node(
            package=PACKAGE,
            executable="camera",
            namespace=camera_id,
            parameters=[params_file, {"source": source}],
            condition=IfCondition(from_source),
        ),
        Node(
            package=PACKAGE,
            executable="view_watch",
            namespace=camera_id,
            parameters=[
                params_file,
                {"calibration_file": calibration, "state_file": LaunchConfiguration("view_file")},
            ],
            condition=IfCondition(AndSubstitution(from_source, LaunchConfiguration("watch_view"))),
        ),
        Node(
            package=PACKAGE,
            executable="detector",
            namespace=camera_id,
            parameters=[params_file, {"model": model}],
            condition=IfCondition(from_source),
        ),
        Node(
            package=PACKAGE,
            executable="tracker",
            namespace=camera_id,
            parameters=[params_file],
            condition=IfCondition(from_source),
        ),
        Node(
            package=PACKAGE,
            executable="overlay",
            namespace=camera_id,
            parameters=[params_file, {"calibration_file": calibration}],
            condition=IfCondition(from_source),
        ),
        Node(
            package=PACKAGE,
            executable="homography",
            namespace=camera_id,
            parameters=[params_file, sim_time, {"calibration_file": calibration}],
        ),
        Node(
            package=PACKAGE,
            executable="lane_geometry",
            namespace=camera_id,
            parameters=[params_file, sim_time],
        ),
        Node(
            package=PACKAGE,
            executable="recorder",
            namespace=camera_id,
            parameters=[params_file, sim_time, {"database": database}],
            condition=IfCondition(NotEqualsSubstitution(database, "")),
        ),
        Node(
            package=PACKAGE,
            executable="traffic",
            namespace=camera_id,
            parameters=[
                params_file,
                sim_time,
                {"database": database, "timezone": timezone, "calibration_file": calibration},
            ],
            condition=IfCondition(LaunchConfiguration("traffic")),
        ),
        Node(
            package=PACKAGE,
            executable="bag_player",
            namespace=camera_id,
            parameters=[
                params_file,
                {
                    "bag": bag,
                    "rate": ParameterValue(rate, value_type=float),
                    "camera_id": camera_id,
                },
            ],
            condition=IfCondition(from_bag),
        ),
        Node(
            package="rviz2",
            executable="rviz2",
            namespace=camera_id,
            arguments=["-d", PathJoinSubstitution([share, "params", "geoorbit.rviz"])],
            parameters=[sim_time],
            condition=IfCondition(LaunchConfiguration("rviz")),
        ),
    ]
