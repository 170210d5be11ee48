"""What is installed: the locks say what setup.py says, and each file has a hash."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from packaging.markers import Marker
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
# The first line of a package in a lock: its name, version and, where there is one, marker.
PACKAGE = re.compile(r"^([a-z0-9-]+)==(\S+)(?: ; (.+?))? \\$", re.MULTILINE)


def packages(lock: str, python: str) -> dict[str, str]:
    """Return the versions that a lock has for a version of Python, by name."""
    text = (ROOT / "locks" / f"{lock}.txt").read_text(encoding="utf-8")
    environment = {"python_full_version": f"{python}.0", "python_version": python}
    return {
        name: version
        for name, version, marker in PACKAGE.findall(text)
        if not marker or Marker(marker).evaluate(environment)
    }


def direct(lock: str) -> set[str]:
    """Return the names of the packages that a lock has because they were asked for, and not for another's sake."""
    text = (ROOT / "locks" / f"{lock}.txt").read_text(encoding="utf-8")
    blocks = re.split(r"^(?=[a-z0-9-]+==)", text, flags=re.MULTILINE)
    return {block.split("==")[0] for block in blocks if f"-r .tools/{lock}.in" in block}


def pins(file: str) -> dict[str, str]:
    """Return the versions in a file of locks/ that has no hashes."""
    lines = (ROOT / "locks" / file).read_text(encoding="utf-8").splitlines()
    return dict(line.split("==") for line in lines if not line.startswith("#"))


@pytest.mark.parametrize("lock", ["wheels", "ros", "container", "tools"])
def test_a_lock_fits_setup_py(lock):
    """It does not after a change of setup.py: `make lock` mends that."""
    command = [sys.executable, "scripts/requirements.py", lock]
    printed = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    requirements = [Requirement(line) for line in printed.splitlines()]
    elsewhere = pins("torch.txt") | (pins("ros-numpy.txt") if lock in ("ros", "container") else {})
    for python in ("3.11", "3.12"):
        locked = packages(lock, python) | elsewhere
        for requirement in requirements:
            version = locked.get(canonicalize_name(requirement.name))
            assert version, f"locks/{lock}.txt lacks {requirement}: make lock"
            assert version in requirement.specifier, f"locks/{lock}.txt has {version} of {requirement}: make lock"
    asked = {canonicalize_name(requirement.name) for requirement in requirements} - set(elsewhere)
    assert direct(lock) == asked, "make lock"


@pytest.mark.parametrize("lock", ["wheels", "ros", "container", "tools"])
def test_each_package_of_a_lock_has_a_hash(lock):
    text = (ROOT / "locks" / f"{lock}.txt").read_text(encoding="utf-8")
    versions = re.findall(r"^[^\s#]\S*==\S+", text, re.MULTILINE)
    blocks = re.findall(r"^\S+==[^\n]+\\\n(?:    --hash=sha256:[0-9a-f]{64}(?: \\)?\n)+", text, re.MULTILINE)
    assert len(blocks) == len(versions) > 20


def test_what_is_locked_beside_torch_is_for_this_torch():
    rules = (ROOT / "locks" / "uv.toml").read_text(encoding="utf-8")
    assert f'name = "torch"\nversion = "{pins("torch.txt")["torch"]}"' in rules
