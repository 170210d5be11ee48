"""Relocalization of a camera in a 3D Gaussian Splatting map, for ROS 2 and without."""

import os

from gsfeatloc_ros.common.kernel_cache import set_kernel_cache

# Before torch and numba load OpenMP: its threads would spin while they wait for each other, which on busy cores makes
# every call wait for the scheduler (measured: XFeat took 1500 ms instead of 50 beside one other busy process).
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
set_kernel_cache()
