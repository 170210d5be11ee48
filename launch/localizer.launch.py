"""Start the localizer on a map, with its topics remapped to those of a camera."""

from __future__ import annotations

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

TOPICS = ("image", "camera_info", "prior", "initialpose", "odom")


def generate_launch_description() -> LaunchDescription:
    """Return the node with its arguments: the map, a file of parameters, a namespace and a name for each topic."""
    default_params = PathJoinSubstitution([FindPackageShare("gsfeatloc_ros"), "config", "localizer.yaml"])
    return LaunchDescription(
        [
            DeclareLaunchArgument("map", description="Path of the 3D Gaussian Splatting map"),
            DeclareLaunchArgument("params_file", default_value=default_params, description="YAML of parameters"),
            DeclareLaunchArgument("namespace", default_value="", description="Namespace of the node and its topics"),
            *(
                DeclareLaunchArgument(topic, default_value=topic, description=f"Topic to use as {topic}")
                for topic in TOPICS
            ),
            Node(
                package="gsfeatloc_ros",
                executable="localizer",
                name="localizer",
                namespace=LaunchConfiguration("namespace"),
                output="screen",
                parameters=[
                    LaunchConfiguration("params_file"),
                    {"map.path": ParameterValue(LaunchConfiguration("map"), value_type=str)},
                ],
                remappings=[(topic, LaunchConfiguration(topic)) for topic in TOPICS],
            ),
        ]
    )
