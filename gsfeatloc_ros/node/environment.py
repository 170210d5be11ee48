"""What the environment must hold for the node to start."""

from __future__ import annotations

import os
from collections.abc import Mapping

# A larger one has no port left in UDP.
_MAX_DOMAIN_ID = 232


def check_environment(environment: Mapping[str, str] = os.environ) -> None:
    """Raise ValueError, which says what to set, where libraries would end the process or say less than why."""
    domain = environment.get("ROS_DOMAIN_ID", "")
    if domain and not (domain.isdecimal() and int(domain) <= _MAX_DOMAIN_ID):
        raise ValueError(f"ROS_DOMAIN_ID is {domain!r}: set it to a number from 0 to {_MAX_DOMAIN_ID}")
    threads = environment.get("NUMBA_NUM_THREADS", "")
    if threads and not (threads.isdecimal() and int(threads) > 0):
        raise ValueError(f"NUMBA_NUM_THREADS is {threads!r}: set it to a number of threads, or not at all")
    folder = next((name for name in ("ROS_LOG_DIR", "ROS_HOME", "HOME") if environment.get(name)), None)
    if folder is None:
        raise ValueError("neither ROS_LOG_DIR nor HOME is set: set ROS_LOG_DIR to a folder for the logs")
    if os.path.exists(environment[folder]) and not os.path.isdir(environment[folder]):
        raise ValueError(f"{folder} is {environment[folder]!r}, which is no folder: set it to one, for the logs")
