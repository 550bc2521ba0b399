"""The detector, configured and activated by default.

ros2 launch yolov5_lifecycle yolov5.launch.py image:=/camera/image_raw params_file:=$HOME/yolov5.yaml

Arguments are validated before a process is started.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Iterator
from difflib import get_close_matches
from pathlib import Path

from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction, TimerAction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import LifecycleNode, Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchContext, LaunchDescription, LaunchDescriptionEntity

DEFAULT_PARAMETERS = PathJoinSubstitution([FindPackageShare("yolov5_lifecycle"), "config", "yolov5.yaml"])
FOLDER = Path(__file__).resolve().parent
BOOLEANS = ["true", "false", "True", "False"]
LOG_LEVELS = ["debug", "info", "warn", "error", "fatal"]
ARGUMENTS_OF_LAUNCH = {
    "emulate_tty",
    "launch-prefix",
    "launch-prefix-filter",
    "sigkill_timeout",
    "sigterm_timeout",
}
"""Arguments that launch itself reads, for every process."""


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            DeclareLaunchArgument("namespace", default_value="", description="Namespace of the node."),
            DeclareLaunchArgument("image", default_value="~/image_raw", description="Topic of the images."),
            DeclareLaunchArgument(
                "detections", default_value="~/detections", description="Topic of the detections."
            ),
            DeclareLaunchArgument(
                "params_file", default_value=DEFAULT_PARAMETERS, description="Path of a parameter file."
            ),
            DeclareLaunchArgument("autostart", default_value="true", description="Configure and activate."),
            DeclareLaunchArgument("respawn", default_value="false", description="Restart after exit."),
            DeclareLaunchArgument("log_level", default_value="info", description="debug to fatal."),
            DeclareLaunchArgument("console", default_value="false", description="Also start the console."),
            DeclareLaunchArgument("console_arguments", default_value="", description="See `console --help`."),
            OpaqueFunction(function=checked_detector),
        ]
    )


def checked_detector(context: LaunchContext) -> list[Node | TimerAction]:
    """Detector and console if the arguments are valid; otherwise the launch ends with 1 and the reason."""
    if not (problems := [*unknown_arguments(context), *wrong_values(context)]):
        return [detector(), console(context)]
    if is_started_directly(context):
        fail(context, "\n".join(problems))
    # A launch file that includes this one may have started processes. An exception here would leave them
    # running without a parent; if it is raised from a separate event, launch ends them first.
    failure = OpaqueFunction(function=fail, args=["\n".join(problems)])
    return [TimerAction(period=0.0, actions=[failure])]


def detector() -> LifecycleNode:
    return LifecycleNode(
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


def console(context: LaunchContext) -> Node:
    return Node(
        package="yolov5_lifecycle",
        executable="console",
        arguments=shlex.split(LaunchConfiguration("console_arguments").perform(context)),
        condition=IfCondition(LaunchConfiguration("console")),
        output="screen",
    )


def fail(_: LaunchContext, reason: str) -> None:
    raise RuntimeError(reason)


def wrong_values(context: LaunchContext) -> list[str]:
    """Invalid values that launch and launch_ros only warn about, or reject after starting other processes."""
    path = Path(context.launch_configurations["params_file"])
    problems = []
    if not path.is_file():
        hint = " Write $HOME instead of ~." if path.parts[:1] == ("~",) else ""
        found = "a folder" if path.is_dir() else "no file"
        problems.append(f"params_file: expected a parameter file at '{path}', found {found} there.{hint}")
    for name in ("autostart", "respawn", "console"):
        value = context.launch_configurations[name]
        if value not in BOOLEANS:
            problems.append(f"{name}: expected true or false, found '{value}'.")
    words = context.launch_configurations["console_arguments"]
    try:
        shlex.split(words)
    except ValueError as error:
        problems.append(f"console_arguments: expected words as in a shell, found '{words}' ({error}).")
    return problems + log_level_problems(context.launch_configurations["log_level"])


def log_level_problems(value: str) -> list[str]:
    """A message if the process would exit with 2 because of `value`, which does not end the launch."""
    logger, separator, level = value.rpartition(":=")
    if level.lower() in LOG_LEVELS and bool(logger) == bool(separator) and ":=" not in logger:
        return []
    expected = f"{', '.join(LOG_LEVELS)}, or LOGGER:=LEVEL for one logger"
    hint = suggestion(level.lower(), LOG_LEVELS)
    return [f"log_level: expected {expected}, found '{value}'.{hint}"]


def unknown_arguments(context: LaunchContext) -> list[str]:
    """A message for each argument given to a launch file of this package that it does not declare.

    launch itself ignores those, from the command line and from a launch file that includes this one.
    """
    problems = []
    for include in includes(root_entities(context)):
        if not is_of_this_package(include):
            continue
        (description,) = include.get_sub_entities()
        declared = sorted(argument.name for argument in description.get_launch_arguments())
        given = {name for name, _ in include.launch_arguments if isinstance(name, str)}
        problems += [
            f"Unknown launch argument '{name}'.{suggestion(name, declared)} "
            f"The arguments are: {', '.join(declared)}."
            for name in sorted(given.difference(declared, ARGUMENTS_OF_LAUNCH))
        ]
    return problems


def suggestion(name: str, declared: list[str]) -> str:
    close = get_close_matches(name[:100], declared, n=1)
    return f" Did you mean '{close[0]}'?" if close else ""


def is_started_directly(context: LaunchContext) -> bool:
    """Whether `ros2 launch` was given a launch file of this package, not one that includes it."""
    entities = root_entities(context)
    return bool(entities) and all(
        isinstance(entity, IncludeLaunchDescription) and is_of_this_package(entity) for entity in entities
    )


def root_entities(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    """The root entities of the launch: for `ros2 launch`, the include of the given file."""
    root = getattr(getattr(context.locals, "event", None), "launch_description", None)
    if root is None:
        return []
    return list(root.entities) if isinstance(root, LaunchDescription) else [root]


def includes(entities: Iterable[LaunchDescriptionEntity]) -> Iterator[IncludeLaunchDescription]:
    """Every include in `entities`, recursively."""
    for entity in entities:
        if isinstance(entity, IncludeLaunchDescription):
            yield entity
        yield from includes(entity.describe_sub_entities())
        for _, conditional in entity.describe_conditional_sub_entities():
            yield from includes(conditional)


def is_of_this_package(include: IncludeLaunchDescription) -> bool:
    return Path(include.launch_description_source.location).resolve().parent == FOLDER
