# Sourced by setup.sh and env.sh.

# Whether a ROS 2 Jazzy install is sourced in this shell and serves the Python given.
ros_is_sourced() {
    [ "${ROS_DISTRO:-}" = jazzy ] && [ -n "${AMENT_PREFIX_PATH:-}" ] && "$1" -c 'import rclpy' 2>/dev/null
}
