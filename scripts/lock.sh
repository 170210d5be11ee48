#!/usr/bin/env bash
# Mend what in locks/ no longer fits setup.py; with --upgrade, take the newest versions that setup.py allows.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

# compile NAME OPTION...: one lock, for Python 3.11 and 3.12 and any machine.
compile() {
    local requirements=.tools/$1.in
    .venv/bin/python scripts/requirements.py "$1" >"$requirements"
    .tools/bin/uv pip compile "$requirements" --quiet --universal --python-version 3.11 --generate-hashes \
        --config-file locks/uv.toml --custom-compile-command "make lock" --output-file "locks/$1.txt" "${@:2}" >/dev/null
}

without_torch=(--constraint locks/torch.txt --no-emit-package torch)
with_ros=(--constraint locks/ros-numpy.txt --no-emit-package numpy)
compile wheels "${without_torch[@]}" "$@"
compile ros "${without_torch[@]}" "${with_ros[@]}" "$@"
compile container "${without_torch[@]}" "${with_ros[@]}" "$@"
compile tools "$@"
