"""What the files of the package say of each other."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(__file__).parents[2]
SOURCES = [*sorted((ROOT / "gsfeatloc_ros").rglob("*.py")), *sorted((ROOT / "launch").glob("*.py"))]
# Ours are optional, and in a folder of this package, where rosdep cannot find them.
OURS = "gsfeatloc_interfaces"
ROS = re.compile(r"rclpy|launch|launch_ros|ament_\w+|tf2_\w+|\w+_(msgs|srvs|interfaces)")
# The packages of modules that have another name.
PACKAGES = {"tf2_ros": "tf2_ros_py"}


def manifest() -> ElementTree.Element:
    return ElementTree.parse(ROOT / "package.xml").getroot()


def test_version_is_the_same_in_package_xml_and_setup_py():
    assert manifest().get("format") == "3"
    assert f'version="{manifest().findtext("version")}"' in (ROOT / "setup.py").read_text()


def test_package_xml_names_every_ros_package_that_is_imported():
    named = {element.text for element in manifest() if element.tag in ("depend", "exec_depend")}
    for source in SOURCES:
        packages = {PACKAGES.get(name, name) for name in imported(source) if ROS.fullmatch(name)}
        assert packages - {OURS} <= named, source.name


def imported(source: Path) -> set[str]:
    """Return the top-level names of the modules that a file imports."""
    names = set()
    for item in ast.walk(ast.parse(source.read_text())):
        if isinstance(item, ast.Import):
            names |= {alias.name.split(".")[0] for alias in item.names}
        elif isinstance(item, ast.ImportFrom) and item.level == 0:
            names.add(item.module.split(".")[0])
    return names


def test_license_is_apache_2():
    text = (ROOT / "LICENSE").read_text()
    assert "Apache License" in text
    assert "END OF TERMS AND CONDITIONS" in text
