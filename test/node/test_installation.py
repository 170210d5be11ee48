"""The package as it is installed."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest
from ament_index_python.packages import get_package_prefix, get_package_share_directory

from gsfeatloc_ros.client.process import executable
from gsfeatloc_ros.tools.command import TOOLS

ROOT = Path(__file__).parents[2]


def test_executable_is_where_ros2_run_looks():
    assert executable() == Path(get_package_prefix("gsfeatloc_ros")) / "lib" / "gsfeatloc_ros" / "localizer"
    assert os.access(executable(), os.X_OK)


@pytest.mark.parametrize("name", ["gsfeatloc", *TOOLS])
def test_each_tool_is_where_ros2_run_looks(name):
    assert os.access(executable().with_name(name), os.X_OK)


def test_a_tool_runs_as_ros2_run_does():
    done = subprocess.run([executable().with_name("index"), "nowhere.ply"], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (2, "index: nowhere.ply: cannot be read: there is no such map\n")


def test_share_has_config_and_launch_and_manifest():
    share = Path(get_package_share_directory("gsfeatloc_ros"))
    for name in ("package.xml", *files("config"), *files("launch")):
        assert (share / name).read_text() == (ROOT / name).read_text()


def files(folder: str) -> list[str]:
    return [str(path.relative_to(ROOT)) for path in (ROOT / folder).iterdir() if path.is_file()]


def test_every_module_is_installed():
    prefix = Path(get_package_prefix("gsfeatloc_ros"))
    installed = {str(path.relative_to(prefix).as_posix()) for path in prefix.rglob("*.py")}
    for source in (ROOT / "gsfeatloc_ros").rglob("*.py"):
        assert any(path.endswith(source.relative_to(ROOT).as_posix()) for path in installed), source
