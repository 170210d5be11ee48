"""A short run of the fuzz campaign (`make fuzz`)."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import gsfeatloc_ros

SCRIPT = Path(__file__).parents[2] / "scripts" / "fuzz.py"


def fuzz(kept: Path, *arguments: str) -> subprocess.CompletedProcess:
    environment = os.environ | {"PYTHONPATH": str(Path(gsfeatloc_ros.__file__).parents[1])}
    command = [sys.executable, str(SCRIPT), "--kept", str(kept), *arguments]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)


def test_damaged_inputs_are_refused_or_accepted(tmp_path):
    """Some of each kind; none crashes, hangs or takes much memory."""
    finished = fuzz(tmp_path / "kept", "--inputs", "600", "--seed", "3")
    assert finished.returncode == 0, finished.stdout + finished.stderr
    *rows, total = finished.stdout.splitlines()
    accepted, refused, crashes, hangs, peak = map(
        int,
        re.fullmatch(
            r"600 inputs: (\d+) accepted, (\d+) refused, (\d+) crash, (\d+) hang, peak memory (\d+) MB", total
        ).groups(),
    )
    assert (accepted + refused, crashes, hangs) == (600, 0, 0)
    assert min(accepted, refused) > 50
    assert peak < 500
    assert len(rows) > 25
    assert not (tmp_path / "kept").exists()
