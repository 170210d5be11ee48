"""Answers held against odometry: what of the map's scale, the clocks and the camera's mounting does not fit."""
