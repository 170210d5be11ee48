"""Imports: run one way from room to room, without circles, and keep ROS and heavy libraries where they belong."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
# Each may import those before it. docs/architecture.md has the same list, from the top.
ROOMS = [
    *("common", "maps", "render", "match", "pose", "index", "localize", "crosscheck", "ros_io"),
    *("simulate", "evaluate", "inspect", "benchmark", "replay", "align", "view", "node", "client", "tools"),
]
# Those that talk to ROS. Of tools/, two start a node.
ROS_ROOMS = {"node", "client"}
ROS_TOOLS = {"gsfeatloc_ros.tools.demo", "gsfeatloc_ros.tools.soak"}
ROS = re.compile(r"(rclpy|rpyutils|launch|launch_ros|rosidl_\w+|ament_\w+|rcl_\w+|tf2_\w+|\w+_(msgs|srvs|interfaces))$")


def name_of(source: Path) -> str:
    """Return the name of the module in a file."""
    parts = source.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


SOURCES = {name_of(source): source for source in sorted((ROOT / "gsfeatloc_ros").rglob("*.py"))}


@cache
def imported(module: str, at_import_only: bool = False) -> list[str]:
    """Return the names of all that a module imports; with `at_import_only` not what functions import later."""

    def visit(node: ast.AST) -> Iterator[str]:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module} imports relatively"
            yield node.module
            # What is imported may be a module too.
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif not at_import_only or not (isinstance(node, ast.FunctionDef) or is_for_types(node)):
            for child in ast.iter_child_nodes(node):
                yield from visit(child)

    return list(visit(ast.parse(SOURCES[module].read_text(encoding="utf-8"))))


def is_for_types(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"


def room_of(module: str) -> str | None:
    """Return the room of a module of this package; None of the package itself, and of others."""
    parts = module.split(".")
    return parts[1] if parts[0] == "gsfeatloc_ros" and len(parts) > 1 else None


def test_every_module_is_in_a_room():
    assert {room_of(module) for module in SOURCES} == {None, *ROOMS}


def test_the_rooms_are_those_of_the_documents():
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    assert re.findall(r"^\| `gsfeatloc_ros/(\w+)/` \|", page, re.MULTILINE) == ROOMS[::-1]


def test_imports_run_one_way():
    for module in SOURCES:
        room = room_of(module)
        below = ROOMS if room is None else ROOMS[: ROOMS.index(room)]
        for other in imported(module):
            if other in SOURCES and room_of(other) not in (None, room):
                assert room_of(other) in below, f"{module} imports {other}"


def test_the_simulated_room_knows_nothing_of_what_is_tested_with_it():
    for module in SOURCES:
        if room_of(module) == "simulate":
            assert {room_of(other) for other in imported(module)} <= {None, "simulate", "common", "maps"}, module


def test_there_are_no_circles():
    done: set[str] = set()

    def follow(module: str, way: tuple[str, ...]) -> None:
        assert module not in way, " -> ".join([*way[way.index(module) :], module])
        if module in done:
            return
        for other in set(imported(module, at_import_only=True)):
            # A package's own modules are imported by its __init__, and name it in `from package import module`.
            if other in SOURCES and not module.startswith(f"{other}."):
                follow(other, (*way, module))
        done.add(module)

    for module in SOURCES:
        follow(module, ())


def talks_to_ros(module: str) -> bool:
    return room_of(module) in ROS_ROOMS or module in ROS_TOOLS


def test_only_those_who_talk_to_ros_import_it():
    for module in SOURCES:
        of_ros = [other for other in imported(module) if ROS.match(other.split(".")[0])]
        assert talks_to_ros(module) or not of_ros, f"{module} imports {of_ros}"


def run(code: str) -> subprocess.CompletedProcess:
    """Run code in a Python of its own."""
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, cwd=ROOT)


@pytest.mark.slow
def test_all_others_can_be_imported_without_ros():
    others = [module for module in SOURCES if not talks_to_ros(module)]
    code = f"""
import importlib, re, sys
class Hide:
    def find_spec(self, name, path=None, target=None):
        if re.match({ROS.pattern!r}, name.split(".")[0]):
            raise ImportError(f"{{name}} is hidden")
sys.meta_path.insert(0, Hide())
for module in {others}:
    importlib.import_module(module)
"""
    done = run(code)
    assert done.returncode == 0, done.stderr


def test_the_import_of_the_package_is_light():
    code = """
import os, sys
before = dict(os.environ)
import gsfeatloc_ros
assert dict(os.environ) == before
print(*sorted({name.split(".")[0] for name in sys.modules} & {"numba", "torch", "cv2", "numpy", "scipy", "rclpy"}))
"""
    done = run(code)
    assert (done.returncode, done.stdout.strip()) == (0, ""), done.stderr
