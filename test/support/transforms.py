"""Messages for tf."""

from __future__ import annotations

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped

from gsfeatloc_ros.common.geometry import quaternion_from_matrix


def transform_stamped(parent: str, child: str, T_parent_child: np.ndarray, stamp: Time) -> TransformStamped:
    """Return the pose (4, 4) of a frame in its parent."""
    message = TransformStamped(child_frame_id=child)
    message.header.frame_id, message.header.stamp = parent, stamp
    translation, rotation = message.transform.translation, message.transform.rotation
    translation.x, translation.y, translation.z = T_parent_child[:3, 3].tolist()
    rotation.x, rotation.y, rotation.z, rotation.w = quaternion_from_matrix(T_parent_child[:3, :3]).tolist()
    return message
