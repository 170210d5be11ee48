"""ROS messages in and out without rclpy: for the node, and for bags where no ROS is installed."""
