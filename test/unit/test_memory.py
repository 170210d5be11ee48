"""How much memory is left."""

from __future__ import annotations

import resource
import subprocess
import sys
from pathlib import Path

import pytest

import gsfeatloc_ros
from gsfeatloc_ros.common.memory import available_memory

GB = 10**9


@pytest.fixture
def machine(tmp_path):
    """A made-up one with 8 GB left, and this process in the group /robot/localizer."""
    for name, content in {
        "proc/meminfo": f"MemTotal: 16000000 kB\nMemAvailable: {8 * GB // 1024} kB\n",
        "proc/self/cgroup": "0::/robot/localizer\n",
        "cgroup/robot/localizer/memory.max": "max\n",
        "cgroup/robot/localizer/memory.current": "1000\n",
    }.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(content)

    def available(**files: str) -> int:
        for name, content in files.items():
            (tmp_path / "cgroup" / name.replace("__", "/").replace("_", ".")).write_text(content)
        return available_memory(tmp_path / "proc", tmp_path / "cgroup")

    return available


def test_of_the_machine(machine):
    assert machine() == pytest.approx(8 * GB, abs=1024)


def test_of_the_container_or_one_round_it(machine):
    limited = {"robot__memory_max": f"{3 * GB}", "robot__memory_current": f"{2 * GB}"}
    assert machine(**limited) == GB
    assert machine(robot__memory_stat=f"anon 5\ninactive_file {GB // 2}\n") == GB + GB // 2
    inner = {"robot__localizer__memory_max": f"{GB}", "robot__localizer__memory_current": f"{GB + 5}"}
    assert machine(**inner) == 0


def test_of_the_process(machine):
    script = f"""
import resource
resource.setrlimit(resource.RLIMIT_AS, ({GB}, resource.RLIM_INFINITY))
from gsfeatloc_ros.common.memory import available_memory
left = available_memory()
held = bytearray({GB // 4})
print(left, left - available_memory())
"""
    package = Path(gsfeatloc_ros.__file__).parents[1]
    finished = subprocess.run([sys.executable, "-c", script], cwd=package, capture_output=True, text=True, check=True)
    left, taken = map(int, finished.stdout.split())
    assert 0 < left < GB
    assert taken == pytest.approx(GB // 4, rel=0.1)


def test_without_proc_there_is_no_limit(tmp_path):
    if resource.getrlimit(resource.RLIMIT_AS)[0] == resource.RLIM_INFINITY:
        assert available_memory(tmp_path, tmp_path) > 2**50
