"""What scripts/setup.sh makes .venv of."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def found(folder: Path) -> str:
    """Return the Python that setup.sh finds where this folder comes first in the PATH."""
    (function,) = re.findall(r"^find_python.*?^}$", (ROOT / "scripts/setup.sh").read_text(), re.MULTILINE | re.DOTALL)
    environment = os.environ | {"PATH": f"{folder}:/usr/bin:/bin"}
    environment.pop("PYTHON", None)
    command = ["bash", "-c", f"{function}\nfind_python"]
    return subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout.strip()


def test_an_active_environment_is_not_made_anew(tmp_path):
    outside, active = tmp_path / "outside", tmp_path / "venv"
    outside.mkdir()
    # As most systems have it: python3 is a link to the file that has the version in its name.
    (outside / "python3").symlink_to(Path(sys._base_executable).resolve())
    subprocess.run([outside / "python3", "-m", "venv", "--without-pip", active], check=True)
    assert found(outside) == found(active / "bin") == str(Path(sys._base_executable).resolve())
