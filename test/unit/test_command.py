"""The command gsfeatloc and the tools behind it: they are all there, complete their words and refuse what they must."""

from __future__ import annotations

import ast
import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest
from small_maps import random_map

from gsfeatloc_ros.maps.ply import write_ply
from gsfeatloc_ros.tools import command
from gsfeatloc_ros.tools.command import TOOLS

ROOT = Path(__file__).parents[2]
# Those that talk to ROS.
NEED_ROS = {"demo", "soak"}
# The command lines of each tool in which BAD is a file or a folder, and MAP a map.
COMMAND_LINES = {
    "inspect": ["BAD", "MAP --photos BAD", "MAP --html BAD/page.html"],
    "view": ["BAD", "MAP --answers BAD", "MAP --params-file BAD"],
    "render": [
        "BAD --pose 0 0 0 0 0 0 1 --fov 60 --size 64x48 --out OUT",
        "MAP --path BAD --fov 60 --size 64x48 --out OUT",
        "MAP --pose 0 0 0 0 0 0 1 --camera BAD --out OUT",
    ],
    "index": ["BAD", "MAP --poses BAD"],
    "prepare": ["BAD --out OUT", "MAP --out OUT --align BAD", "MAP --out OUT --poses BAD"],
    "align": [
        "trajectory --answers BAD --trajectory BAD --out OUT",
        "drive BAD --map MAP --image /i --camera-info /c --odom /o --out OUT",
        # The trajectory is looked at before the photos are localized.
        "drive NOWHERE --map MAP --image /i --camera-info /c --trajectory BAD --out OUT",
        "gravity --map MAP --answers BAD --level --out OUT",
        "target --scene BAD --tag 36h11 --size 0.1 --out OUT",
    ],
    "warmup": ["--matcher xfeat --weights BAD"],
    "replay": ["BAD --map MAP --image /i --camera-info /c --out OUT"],
    "demo": ["--out BAD"],
    "evaluate": ["BAD"],
    "negatives": ["BAD"],
    "benchmark": ["render --map BAD", "render --scene BAD", "query --scene BAD"],
    "soak": ["--folder BAD"],
    "parameters": ["--root BAD"],
}
KINDS = ["missing", "folder", "empty", "garbage"]
# Made by those that write there.
MADE = {("demo", "missing"), ("demo", "folder"), ("soak", "missing"), ("soak", "folder")}


def run(*arguments: str, **environment: str) -> subprocess.CompletedProcess:
    """Run the command in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "gsfeatloc_ros.tools.command", *arguments],
        capture_output=True,
        text=True,
        timeout=60,
        cwd=ROOT,
        env=os.environ | environment,
    )


def test_every_tool_is_in_the_table_and_in_setup_py() -> None:
    others = {"__init__", "command", "options", "status", "strangers"}  # the last is an old name
    assert {path.stem for path in (ROOT / "gsfeatloc_ros" / "tools").glob("*.py")} - others == set(TOOLS)
    (listed,) = (
        ast.literal_eval(item.value)
        for item in ast.parse((ROOT / "setup.py").read_text()).body
        if isinstance(item, ast.Assign) and item.targets[0].id == "tools"
    )
    assert sorted(TOOLS) == listed


def test_without_a_tool_or_with_an_unknown_one_it_names_them(capsys) -> None:
    for arguments in ([], ["nothing"]):
        with pytest.raises(SystemExit, match="2"):
            command.main(arguments)
        assert "usage: gsfeatloc [-h] TOOL" in capsys.readouterr().err


def test_help_names_all_tools_and_imports_nothing_heavy() -> None:
    code = """
import sys
from gsfeatloc_ros.tools import command
try:
    command.main(["--help"])
finally:
    print("heavy:", *sorted({name.split(".")[0] for name in sys.modules} & {"numpy", "numba", "torch", "cv2", "rclpy"}))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, cwd=ROOT)
    assert done.returncode == 0
    assert done.stdout.splitlines()[-1] == "heavy:"
    assert set(TOOLS) <= set(done.stdout.split())


@pytest.mark.parametrize("name", TOOLS)
def test_help_says_how_the_tool_is_called(name, capsys) -> None:
    if name in NEED_ROS:
        pytest.importorskip("rclpy")
    with pytest.raises(SystemExit, match="0"):
        command.main([name, "--help"])
    text = capsys.readouterr().out
    assert text.startswith(f"usage: gsfeatloc {name} ")
    assert "python -m" not in text


# In each OUT cannot be written. That is said first: there is no MAP, no SCENE, and what is measured takes minutes.
OUTPUTS = [
    "inspect MAP --json OUT",
    "inspect MAP --html OUT",
    "view MAP --out OUT",
    "render MAP --pose 0 0 0 0 0 0 1 --fov 60 --size 64x48 --out OUT",
    "render MAP --path MAP --fov 60 --size 64x48 --video OUT",
    "index MAP --out OUT",
    "align trajectory --answers MAP --trajectory MAP --out OUT",
    "align distance --points 0 0 0 1 0 0 --distance 1 --out OUT",
    "evaluate SCENE --json OUT",
    "negatives SCENE --json OUT",
    "benchmark render --map MAP --json OUT",
    "benchmark query --scene SCENE --json OUT",
    "benchmark synthetic --out OUT",
    "benchmark scaling --out OUT",
    "benchmark index --out OUT",
    "benchmark twins --json OUT",
    "soak --json OUT",
]
# Options with numbers that they do not take.
NUMBERS = [
    "evaluate SCENE --limit -1",
    "evaluate SCENE --sigma nan",
    "negatives SCENE --limit -1",
    "negatives SCENE --sigma inf",
    "negatives SCENE --seed -1",
    "benchmark render --map MAP --frames 0",
    "benchmark render --map MAP --threads -1",
    "benchmark render --map MAP --size 640x99999",
    "benchmark render --map MAP --pose 0 0 0 0 0 0 nan",
    "benchmark query --scene SCENE --sigma nan",
    "benchmark track --scene SCENE --frames 0",
    "benchmark synthetic --gaussians 0 --out OUT",
    "benchmark synthetic --seed -1 --out OUT",
    "benchmark scaling --max-gaussians 1 --out OUT",
    "benchmark index --max-views 1 --out OUT",
    "benchmark twins --photos 0",
    "demo --photos 0",
    "soak --seconds nan",
    "soak --rate 0",
    "soak --size 640x0",
]


@pytest.fixture
def places(tmp_path) -> dict[str, str]:
    write_ply(tmp_path / "map.ply", random_map(50, 0, seed=0))
    (tmp_path / "folder").mkdir()
    (tmp_path / "empty").touch()
    (tmp_path / "garbage").write_bytes(bytes(range(256)) * 5)
    named = {"MAP": "map.ply", "OUT": "out"} | {kind: kind for kind in KINDS}
    return {word: str(tmp_path / name) for word, name in named.items()}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("line", [f"{name} {line}" for name, lines in COMMAND_LINES.items() for line in lines])
def test_what_cannot_be_used_is_named_in_one_line_with_status_2(line, kind, places, capfd) -> None:
    name, *words = line.split()
    if (name, kind) in MADE or (kind == "folder" and "BAD/" in line):
        pytest.skip("it is a place to write to")
    if name in NEED_ROS:
        pytest.importorskip("rclpy")
    bad = places[kind]
    tool = importlib.import_module(f"gsfeatloc_ros.tools.{name}")
    assert tool.main([places.get(word, word).replace("BAD", bad) for word in words]) == 2
    *notes, reason = capfd.readouterr().err.splitlines()
    assert reason.startswith(f"{name}: ")
    assert bad in reason
    assert "Traceback" not in "".join(notes)


@pytest.mark.parametrize("out", ["folder", "missing/out", "empty/out", "/proc/out"])
@pytest.mark.parametrize("line", OUTPUTS)
def test_an_output_that_cannot_be_written_is_named_before_the_work(line, out, places, tmp_path, capfd) -> None:
    name, *words = line.split()
    if name in NEED_ROS:
        pytest.importorskip("rclpy")
    if out == "folder" and "render MAP --pose" in line:
        pytest.skip("it is the beginning of names: folder.png")
    named = {"MAP": places["missing"], "SCENE": places["missing"], "OUT": str(tmp_path / out)}
    tool = importlib.import_module(f"gsfeatloc_ros.tools.{name}")
    try:
        status = tool.main([named.get(word, word) for word in words])
    except SystemExit as ended:
        status = ended.code
    assert status == 2
    reason = capfd.readouterr().err.splitlines()[-1]
    assert str(tmp_path / out) in reason
    assert "cannot be written" in reason or "there is no folder" in reason
    assert not (tmp_path / "missing").exists()


@pytest.mark.parametrize("line", NUMBERS)
def test_a_number_that_an_option_does_not_take_is_named(line, capsys) -> None:
    name, *words = line.split()
    if name in NEED_ROS:
        pytest.importorskip("rclpy")
    with pytest.raises(SystemExit, match="2"):
        importlib.import_module(f"gsfeatloc_ros.tools.{name}").main(words)
    reason = capsys.readouterr().err.splitlines()[-1]
    option = next(word for word in reversed(words) if word.startswith("--") and word != "--out")
    assert f"error: argument {option}: " in reason


def test_every_tool_is_tried_with_what_cannot_be_used() -> None:
    assert set(COMMAND_LINES) == set(TOOLS)


@pytest.mark.parametrize(
    ("line", "expected"),
    [("gsfeatloc war", {"warmup"}), ("gsfeatloc warmup --mat", {"--matcher"}), ("gsfeatloc war --mat", set())],
)
def test_words_are_completed(line, expected, tmp_path) -> None:
    answer = tmp_path / "answer"
    point = str(len(line))
    run(_ARGCOMPLETE="1", COMP_LINE=line, COMP_POINT=point, _ARGCOMPLETE_STDOUT_FILENAME=str(answer), IFS="\v")
    words = answer.read_text().split("\v") if answer.exists() else []
    assert {word.strip() for word in words if word} == expected


@pytest.mark.skipif(not (ROOT / ".venv/bin/activate").exists(), reason="it is of a clone that was set up")
def test_the_environment_of_a_clone_has_the_command():
    run = subprocess.run(
        ["bash", "-c", ". scripts/env.sh && gsfeatloc --help"], cwd=ROOT, capture_output=True, text=True, timeout=120
    )
    assert run.returncode == 0, run.stderr
    assert run.stdout.startswith("usage: gsfeatloc")
