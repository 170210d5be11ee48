"""A short run of what `make fuzz` sends to the installed node."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "scripts" / "fuzz_node.py"


@pytest.mark.nightly
def test_strange_inputs_are_borne():
    command = [sys.executable, "-P", SCRIPT, "--inputs", "500", "--seconds", "200", "--seed", "5"]
    finished = subprocess.run(command, capture_output=True, text=True, timeout=500)
    assert finished.returncode == 0, finished.stdout + finished.stderr
