"""A camera that shows moving shapes, the detector that knows them and, if asked for, RViz to look at both.

ros2 launch yolov5_lifecycle demo.launch.py rviz:=true
"""

from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

SHARE = FindPackageShare("yolov5_lifecycle")
DEFAULT_PARAMETERS = PathJoinSubstitution([SHARE, "config", "demo.yaml"])


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
        condition=IfCondition(LaunchConfiguration("rviz")),
    )
    return LaunchDescription(
        [
            DeclareLaunchArgument("source", default_value="synthetic", description="See `camera --help`."),
            DeclareLaunchArgument("params_file", default_value=DEFAULT_PARAMETERS, description="Parameters."),
            DeclareLaunchArgument("rviz", default_value="false", description="Show the images in RViz."),
            room_for_images,
            camera,
            detector,
            rviz,
        ]
    )
