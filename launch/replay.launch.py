"""Play a bag into the localizer, as fast as it was recorded: the bag's clock is everyone's, and starts with the node.

For the localizer alone, on every image and without a ROS graph: python -m gsfeatloc_ros.tools.replay.
"""

from __future__ import annotations

from launch.actions import (
    DeclareLaunchArgument,
    ExecuteProcess,
    IncludeLaunchDescription,
    RegisterEventHandler,
    Shutdown,
)
from launch.event_handlers import OnProcessIO
from launch.events.process import ProcessIO
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription


def generate_launch_description() -> LaunchDescription:
    """Return the localizer, and the player of a bag that starts when the localizer is ready."""
    play = ExecuteProcess(
        cmd=["ros2", "bag", "play", LaunchConfiguration("bag"), "--clock", "--rate", LaunchConfiguration("rate")],
        output="screen",
        on_exit=Shutdown(reason="the bag has ended"),
    )
    started = False

    def start_when_ready(event: ProcessIO) -> list[ExecuteProcess]:
        # Not before: the node first loads the map and compiles, and would miss what is played then.
        nonlocal started
        if started or b"]: ready" not in event.text:
            return []
        started = True
        return [play]

    arguments = {"map": LaunchConfiguration("map"), "use_sim_time": "true"}
    localizer = PathJoinSubstitution([FindPackageShare("gsfeatloc_ros"), "launch", "localizer.launch.py"])
    return LaunchDescription(
        [
            DeclareLaunchArgument("bag", description="Path of the rosbag2"),
            DeclareLaunchArgument("map", description="Path of the 3D Gaussian Splatting map"),
            DeclareLaunchArgument("rate", default_value="1.0", description="Times the speed of the recording"),
            RegisterEventHandler(OnProcessIO(on_stdout=start_when_ready, on_stderr=start_when_ready)),
            # Its other arguments, such as the topics, reach it by themselves.
            IncludeLaunchDescription(localizer, launch_arguments=arguments.items()),
        ]
    )
