"""The detector, configured and activated unless told otherwise.

ros2 launch yolov5_lifecycle yolov5.launch.py image:=/camera/image_raw params_file:=$HOME/yolov5.yaml
"""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import LifecycleNode
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

DEFAULT_PARAMETERS = PathJoinSubstitution([FindPackageShare("yolov5_lifecycle"), "config", "yolov5.yaml"])


def generate_launch_description() -> LaunchDescription:
    detector = LifecycleNode(
        package="yolov5_lifecycle",
        executable="detector",
        name="yolov5",
        namespace=LaunchConfiguration("namespace"),
        parameters=[
            LaunchConfiguration("params_file"),
            {"autostart": ParameterValue(LaunchConfiguration("autostart"), value_type=bool)},
        ],
        remappings=[
            ("~/image_raw", LaunchConfiguration("image")),
            ("~/detections", LaunchConfiguration("detections")),
        ],
        ros_arguments=["--log-level", LaunchConfiguration("log_level")],
        respawn=LaunchConfiguration("respawn"),
        respawn_delay=2.0,
        output="screen",
    )
    return LaunchDescription(
        [
            DeclareLaunchArgument("namespace", default_value="", description="Namespace of the node."),
            DeclareLaunchArgument("image", default_value="~/image_raw", description="Topic of the images."),
            DeclareLaunchArgument(
                "detections", default_value="~/detections", description="Topic of the detections."
            ),
            DeclareLaunchArgument("params_file", default_value=DEFAULT_PARAMETERS, description="Parameters."),
            DeclareLaunchArgument("autostart", default_value="true", description="Configure and activate."),
            DeclareLaunchArgument("respawn", default_value="false", description="Start again after the end."),
            DeclareLaunchArgument("log_level", default_value="info", description="debug to fatal."),
            detector,
        ]
    )
