"""A recorded bag through the localizer, without a ROS graph."""
