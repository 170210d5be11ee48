#!/usr/bin/env bash
# The localizer with the arguments of `docker run`; it is process 1, so that signals reach it.
set -e
source /opt/ros/jazzy/setup.bash
source /opt/gsfeatloc/install/local_setup.bash
exec /opt/gsfeatloc/install/gsfeatloc_ros/lib/gsfeatloc_ros/localizer "$@"
