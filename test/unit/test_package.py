"""The package as it is installed, and what its files say of each other."""

from __future__ import annotations

import ast
import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest
from ament_index_python.packages import get_package_prefix, get_package_share_directory

ROOT = Path(__file__).parents[2]
SOURCES = sorted((ROOT / "gsfeatloc_ros").rglob("*.py"))


def test_executable_is_where_ros2_run_looks():
    path = Path(get_package_prefix("gsfeatloc_ros")) / "lib" / "gsfeatloc_ros" / "localizer"
    assert os.access(path, os.X_OK)


def test_share_has_config_and_launch_and_manifest():
    share = Path(get_package_share_directory("gsfeatloc_ros"))
    configs = ("config/localizer.yaml", "config/fastdds.xml")
    for name in ("package.xml", *configs, "launch/localizer.launch.py", "launch/replay.launch.py"):
        assert (share / name).read_text() == (ROOT / name).read_text()


def test_every_module_is_installed():
    prefix = Path(get_package_prefix("gsfeatloc_ros"))
    installed = {str(path.relative_to(prefix).as_posix()) for path in prefix.rglob("*.py")}
    for source in SOURCES:
        assert any(path.endswith(source.relative_to(ROOT).as_posix()) for path in installed), source


def test_version_is_the_same_in_package_xml_and_setup_py():
    manifest = ElementTree.parse(ROOT / "package.xml").getroot()
    assert manifest.get("format") == "3"
    assert f'version="{manifest.findtext("version")}"' in (ROOT / "setup.py").read_text()


def test_package_xml_names_every_ros_package_that_is_imported():
    manifest = ElementTree.parse(ROOT / "package.xml").getroot()
    named = {element.text for element in manifest if element.tag.endswith("depend")}
    for source in [*SOURCES, *(ROOT / "launch").glob("*.py")]:
        for package in imported(source):
            # Our own interfaces are optional, and in a folder of this package, where rosdep cannot find them.
            if package == "gsfeatloc_interfaces":
                continue
            if package.endswith(("_msgs", "_srvs", "_interfaces")) or package in ("rclpy", "launch", "launch_ros"):
                assert package in named, f"{source.name} imports {package}"


def imported(source: Path) -> set[str]:
    """Top-level names of the modules that a file imports."""
    names = set()
    for item in ast.walk(ast.parse(source.read_text())):
        if isinstance(item, ast.Import):
            names |= {alias.name.split(".")[0] for alias in item.names}
        elif isinstance(item, ast.ImportFrom) and item.level == 0:
            names.add(item.module.split(".")[0])
    return names


def test_only_the_node_imports_ros():
    for source in SOURCES:
        if "node" not in source.relative_to(ROOT).parts:
            assert not imported(source) & {"rclpy", "sensor_msgs", "geometry_msgs", "diagnostic_msgs"}, source


def test_import_without_ros():
    code = "import sys; sys.modules['rclpy'] = None; import gsfeatloc_ros.localize.localizer, gsfeatloc_ros.render"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


@pytest.mark.parametrize(("name", "entities"), [("localizer", 9), ("replay", 6)])
def test_launch_file_makes_a_description(name, entities):
    source = ROOT / "launch" / f"{name}.launch.py"
    code = compile(source.read_text(), source.name, "exec")
    # launch_ros is in a ROS install only, not among the wheels; without it, that the file compiles is all there is.
    if importlib.util.find_spec("launch_ros"):
        module: dict = {}
        exec(code, module)
        assert len(module["generate_launch_description"]().entities) == entities


def test_license_is_apache_2():
    text = (ROOT / "LICENSE").read_text()
    assert "Apache License" in text
    assert "END OF TERMS AND CONDITIONS" in text
