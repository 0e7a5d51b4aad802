"""One camera: its lanes, live, from a video or from a bag.

    ros2 launch geoorbit_ros geoorbit.launch.py camera_id:=north calibration:=calibration.csv \
        source:=rtsp://camera.example/stream rviz:=true
    ros2 launch geoorbit_ros geoorbit.launch.py camera_id:=north calibration:=calibration.csv \
        bag:=north_bag rate:=10 rviz:=true

Wiring only: every number is in the parameter schemas and in `params_file`.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, NotEqualsSubstitution, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

PACKAGE = "geoorbit_ros"


def generate_launch_description() -> LaunchDescription:
    share = FindPackageShare(PACKAGE)
    camera_id = LaunchConfiguration("camera_id")
    source = LaunchConfiguration("source")
    bag = LaunchConfiguration("bag")
    rate = LaunchConfiguration("rate")
    model = LaunchConfiguration("model")
    calibration = LaunchConfiguration("calibration")
    database = LaunchConfiguration("database")
    params_file = LaunchConfiguration("params_file")
    from_source = NotEqualsSubstitution(source, "")
    from_bag = NotEqualsSubstitution(bag, "")
    sim_time = {"use_sim_time": ParameterValue(from_bag, value_type=bool)}

    arguments = [
        DeclareLaunchArgument("camera_id", description="Namespace of the camera."),
        DeclareLaunchArgument("calibration", description="Control points, a CSV file."),
        DeclareLaunchArgument("source", default_value="", description="Video, address or images."),
        DeclareLaunchArgument("model", default_value="", description="YOLO model, an ONNX file."),
        DeclareLaunchArgument("bag", default_value="", description="Play this; empty: live."),
        DeclareLaunchArgument("rate", default_value="1.0", description="Speed of the bag."),
        DeclareLaunchArgument("database", default_value="", description="Record into this file."),
        DeclareLaunchArgument("rviz", default_value="false", description="Show it in RViz."),
        DeclareLaunchArgument(
            "params_file",
            default_value=PathJoinSubstitution([share, "params", "one_camera.yaml"]),
            description="Parameters of the nodes.",
        ),
    ]
    nodes = [
        Node(
            package=PACKAGE,
            executable="camera",
            namespace=camera_id,
            parameters=[params_file, {"source": source}],
            condition=IfCondition(from_source),
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
    return LaunchDescription([*arguments, *nodes])
