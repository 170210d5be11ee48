"""Print what setup.py requires, and what its extras named on the command line add, one requirement a line."""

from __future__ import annotations

import sys
from distutils.core import run_setup  # setuptools provides it on Python 3.12

distribution = run_setup("setup.py", stop_after="init")
print(*distribution.install_requires, sep="\n")
for extra in sys.argv[1:]:
    print(*distribution.extras_require[extra], sep="\n")
