"""Demo: a camera with moving shapes, the detector with a model for them and, optionally, RViz.

ros2 launch yolov5_lifecycle demo.launch.py rviz:=true
"""

from __future__ import annotations

import os

from launch.actions import (
    DeclareLaunchArgument,
    IncludeLaunchDescription,
    OpaqueFunction,
    SetEnvironmentVariable,
)
from launch.conditions import IfCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, SubstitutionFailure
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import ExecutableInPackage, FindPackageShare

from launch import LaunchContext, LaunchDescription

SHARE = FindPackageShare("yolov5_lifecycle")
DEFAULT_PARAMETERS = PathJoinSubstitution([SHARE, "config", "demo.yaml"])
RVIZ_IS_WANTED = IfCondition(LaunchConfiguration("rviz"))


def generate_launch_description() -> LaunchDescription:
    room_for_images = SetEnvironmentVariable(
        "FASTRTPS_DEFAULT_PROFILES_FILE", PathJoinSubstitution([SHARE, "config", "shm.xml"])
    )
    camera = Node(
        package="yolov5_lifecycle",
        executable="camera",
        parameters=[{"source": ParameterValue(LaunchConfiguration("source"), value_type=str)}],
        remappings=[("image_raw", "yolov5/image_raw")],
        output="screen",
    )
    detector = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(PathJoinSubstitution([SHARE, "launch", "yolov5.launch.py"])),
        launch_arguments={"params_file": LaunchConfiguration("params_file")}.items(),
    )
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        arguments=["-d", PathJoinSubstitution([SHARE, "config", "yolov5.rviz"])],
        condition=RVIZ_IS_WANTED,
    )
    return LaunchDescription(
        [
            DeclareLaunchArgument("source", default_value="synthetic", description="See `camera --help`."),
            DeclareLaunchArgument(
                "params_file", default_value=DEFAULT_PARAMETERS, description="Path of a parameter file."
            ),
            DeclareLaunchArgument("rviz", default_value="false", description="Show the images in RViz."),
            OpaqueFunction(function=check_rviz, condition=RVIZ_IS_WANTED),
            room_for_images,
            detector,  # first: it checks the arguments, and launch abandons processes that are starting
            camera,
            rviz,
        ]
    )


def check_rviz(context: LaunchContext) -> None:
    """Raise RuntimeError if RViz is not installed, before any process is started."""
    try:
        ExecutableInPackage(package="rviz2", executable="rviz2").perform(context)
    except (KeyError, SubstitutionFailure) as error:  # no such package, no such file in it
        package = f"ros-{os.environ.get('ROS_DISTRO', 'jazzy')}-rviz2"
        raise RuntimeError(
            f"rviz:=true: RViz is not installed. Install it with `sudo apt install {package}`, "
            "or leave out rviz:=true."
        ) from error
