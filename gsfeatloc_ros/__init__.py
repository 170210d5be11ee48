"""Relocalization of a camera in a 3D Gaussian Splatting map, for ROS 2 and without."""
