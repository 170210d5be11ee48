#!/usr/bin/env bash
# Build with colcon, into install/: the package and, where a compiler is, its interfaces.
set -euo pipefail
cd "$(dirname "$0")/.."
set +u  # colcon's setup files read variables that are not set
. scripts/env.sh
set -u

can_compile() {
    command -v cmake && command -v "${CXX:-c++}" && python -c '
import sys, sysconfig, pathlib
sys.exit(not pathlib.Path(sysconfig.get_path("include"), "Python.h").exists())'
} >/dev/null

paths=(.)
if can_compile; then
    paths+=(interfaces)
    # ROS's wheels have no tf2_msgs; the tests need its one message.
    if ! ros_is_sourced python; then
        paths+=(test/support/tf2_msgs)
    fi
else
    echo "build: the service ~/localize_image is off, it needs cmake, a C++ compiler and Python's headers (Debian, Ubuntu: apt install cmake g++ python3-dev)" >&2
fi
python -m colcon build --base-paths "${paths[@]}" --cmake-args -DBUILD_TESTING=OFF
