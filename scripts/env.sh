# Source it in bash: the environment in which the package is built, tested and run, after scripts/setup.sh.
_root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
. "$_root/scripts/ros.sh"
. "$_root/.venv/bin/activate"
if ! ros_is_sourced "$VIRTUAL_ENV/bin/python"; then
    # ROS from the wheels: nothing of another environment may shine through.
    unset PYTHONPATH LD_LIBRARY_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE
    export AMENT_PREFIX_PATH=$VIRTUAL_ENV CMAKE_PREFIX_PATH=$VIRTUAL_ENV
fi
if [ -f "$_root/install/local_setup.bash" ]; then
    . "$_root/install/local_setup.bash"
fi
export NUMBA_CACHE_DIR=$VIRTUAL_ENV/numba_cache
export FASTRTPS_DEFAULT_PROFILES_FILE=$_root/config/fastdds.xml
unset _root
# What `pip install` would put into .venv/bin.
gsfeatloc() { python -m gsfeatloc_ros.tools.command "$@"; }
