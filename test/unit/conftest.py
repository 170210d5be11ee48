"""These tests need no ROS; those of messages need its messages, nothing more."""

from __future__ import annotations

from importlib.util import find_spec

collect_ignore = [] if find_spec("sensor_msgs") else ["test_messages.py"]
