"""What the files of the package say of each other."""

from __future__ import annotations

import ast
import re
from functools import cache
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
    for item in ast.walk(parsed(source)):
        if isinstance(item, ast.Import):
            names |= {alias.name.split(".")[0] for alias in item.names}
        elif isinstance(item, ast.ImportFrom) and item.level == 0:
            names.add(item.module.split(".")[0])
    return names


# What takes memory as the file says, waits for a pipe or runs code, and the files of the package that may call it: each
# has looked before at the size, or reads what the package or the system wrote.
UNGUARDED = {
    "cv2.imread": (),
    "cv2.imdecode": (
        *("common/jpeg_png.py", "maps/sog.py", "maps/gsplat_png.py", "evaluate/corruptions.py", "view/jpeg.py"),
    ),
    ".read_bytes": ("common/kernel_cache.py", "client/faults.py"),
    ".read_text": (
        *(
            "benchmark/measure.py",
            "common/memory.py",
            "common/threads.py",
            "client/observer.py",
            "tools/parameters.py",
        ),
        *("evaluate/report/page.py", "inspect/page.py"),
    ),
    "np.load": ("maps/gsplat_png.py", "client/observer.py", "client/robot.py", "client/flood.py"),
    "torch.load": ("match/weights.py",),
    "json.load": (),
    "json.loads": (
        *("common/json_file.py", "maps/__init__.py", "maps/sog.py", "render/cache_file.py", "index/storage.py"),
        *("ros_io/saved_pose.py", "evaluate/record.py"),
    ),
    "yaml.safe_load": ("common/yaml_file.py", "ros_io/parameter_file.py"),
    "zipfile.ZipFile": ("maps/sog.py", "maps/gsplat_png.py", "maps/foreign.py"),
}


def test_files_from_outside_are_opened_in_few_places():
    package = ROOT / "gsfeatloc_ros"
    callers = {name: set() for name in UNGUARDED}
    for source in package.rglob("*.py"):
        for item in ast.walk(parsed(source)):
            if isinstance(item, ast.Attribute):
                module = item.value.id if isinstance(item.value, ast.Name) else ""
                for name in {f"{module}.{item.attr}", f".{item.attr}"} & set(callers):
                    callers[name].add(source.relative_to(package).as_posix())
    assert callers == {name: set(files) for name, files in UNGUARDED.items()}


@cache
def parsed(source: Path) -> ast.Module:
    return ast.parse(source.read_text())


def test_license_is_apache_2():
    text = (ROOT / "LICENSE").read_text()
    assert "Apache License" in text
    assert "END OF TERMS AND CONDITIONS" in text
