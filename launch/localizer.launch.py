"""Start the localizer on a map, with its topics remapped to those of a camera and a robot."""

from __future__ import annotations

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchContext, LaunchDescription

INPUTS = ("image", "prior", "prior_with_covariance", "prior_odometry", "initialpose", "odom")
OUTPUTS = ("pose", "protection_level", "rendered_image", "debug_image")


def generate_launch_description() -> LaunchDescription:
    """Return the node with its arguments."""
    default_params = PathJoinSubstitution([FindPackageShare("gsfeatloc_ros"), "config", "localizer.yaml"])
    return LaunchDescription(
        [
            DeclareLaunchArgument("map", description="Path of the 3D Gaussian Splatting map"),
            DeclareLaunchArgument("params_file", default_value=default_params, description="YAML of parameters"),
            DeclareLaunchArgument("namespace", default_value="", description="Namespace of the node and its topics"),
            DeclareLaunchArgument(
                "transport",
                default_value="",
                choices=["", "raw", "compressed"],
                description="How images come; empty for what params_file says",
            ),
            DeclareLaunchArgument(
                "use_sim_time", default_value="false", choices=["true", "false"], description="Take the time of /clock"
            ),
            DeclareLaunchArgument(
                "camera_info", default_value="", description="Topic to use as camera_info; empty: the one beside image"
            ),
            *(
                DeclareLaunchArgument(topic, default_value=topic, description=f"Topic to use as {topic}")
                for topic in (*INPUTS, *OUTPUTS)
            ),
            OpaqueFunction(function=_nodes),
        ]
    )


def _nodes(context: LaunchContext) -> list[Node]:
    """Return the node as the arguments say."""

    def given(argument: str) -> str:
        return LaunchConfiguration(argument).perform(context)

    # A path may look like a number, and is text.
    map_path = ParameterValue(given("map"), value_type=str)
    parameters = {"map.path": map_path, "use_sim_time": given("use_sim_time") == "true"}
    if given("transport"):
        parameters["image.transport"] = given("transport")
    # As image_transport has it: camera/image_raw comes with camera/camera_info.
    folder, slash, _ = given("image").rpartition("/")
    camera_info = given("camera_info") or f"{folder}{slash}camera_info"
    return [
        Node(
            package="gsfeatloc_ros",
            executable="localizer",
            name="localizer",
            namespace=given("namespace"),
            output="screen",
            # Later ones win.
            parameters=[given("params_file"), parameters],
            remappings=[("camera_info", camera_info), *((topic, given(topic)) for topic in (*INPUTS, *OUTPUTS))],
        )
    ]
