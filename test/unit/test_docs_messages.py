"""What documents say of topics, services and messages in the log is what the code has."""

from __future__ import annotations

import ast
import functools
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "gsfeatloc_ros"
PAGE = ROOT / "docs/topics-and-services.md"
# Read files that tools alone take, or what is said is put into a message of the node's.
OF_TOOLS = {"calibration_file.py", "parameter_file.py", "transform_tree.py", "saved_pose.py", "settings.py"}


@functools.cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def text_of(node: ast.AST) -> str | None:
    """Return a text of the sources, with … for what is put in; None for what is no text."""
    if isinstance(node, ast.JoinedStr):
        return "".join(part.value if isinstance(part, ast.Constant) else "…" for part in node.values)
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else None


def texts(room: str) -> set[str]:
    """Return the texts in the sources of a room."""
    found = (text_of(node) for path in (PACKAGE / room).rglob("*.py") for node in ast.walk(tree(path)))
    return {text for text in found if text is not None}


def documented() -> list[str]:
    """Return the messages that docs/troubleshooting.md has."""
    page = (ROOT / "docs/troubleshooting.md").read_text(encoding="utf-8")
    return re.findall(r"^\| `([^`]+)` \|", page, re.MULTILINE) + re.findall(r"says `([^`]+)`", page)


def test_messages_are_those_of_the_code() -> None:
    messages = documented()
    assert len(messages) > 30
    said = set().union(*(texts(room) for room in ("common", "localize", "maps", "node", "render", "ros_io")))
    missing = [message for message in messages if not any(message.strip("… ") in text for text in said)]
    assert not missing


def test_what_the_node_complains_of_is_documented() -> None:
    rows = [re.compile(".*".join(map(re.escape, message.split("…")))) for message in documented()]
    complaints = set(said_by_the_node())
    assert len(complaints) > 50
    assert not [text for text in complaints if not any(row.search(text) for row in rows)]


def said_by_the_node() -> Iterator[str]:
    """Yield what the node's rooms raise, log as a warning or worse, or say against an estimate, where it says much."""
    paths = [path for room in ("node", "ros_io") for path in (PACKAGE / room).glob("*.py")]
    for path in (*(path for path in paths if path.name not in OF_TOOLS), PACKAGE / "localize/evidence.py"):
        for node in ast.walk(tree(path)):
            for text in map(text_of, complaint(node)):
                if text is not None and len(text.replace("…", "").strip(": ,")) > 10:
                    yield text


def complaint(node: ast.AST) -> list[ast.expr]:
    """Return the arguments of a call that complains; none of anything else."""
    if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
        return node.exc.args
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
        of_verdict = isinstance(node.func.value, ast.Name) and node.func.value.id == "reasons"
        if node.func.attr in ("warning", "warn", "error", "fatal") or (node.func.attr == "append" and of_verdict):
            return node.args
    return []


def test_topics_and_services_of_the_code_are_on_the_page() -> None:
    rows = re.findall(
        r"^\| `([\w/~]+)` \| (\w+)/(?:msg/|srv/)?(\w+) \|", PAGE.read_text(encoding="utf-8"), re.MULTILINE
    )
    listed = {(name, kind) for name, _, kind in rows}
    made = set(made_by_the_node())
    assert len(made) > 15
    assert made <= listed


def test_topics_and_services_on_the_page_are_in_the_code() -> None:
    """`/tf` is tf2_ros's; `image/compressed` is image_transport's name beside `image`."""
    listed = re.findall(r"^\| `([\w/~]+)` \| \w+_\w+/", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert len(listed) > 15
    assert set(listed) - {"/tf", "image/compressed"} <= texts("node")


def made_by_the_node() -> Iterator[tuple[str, str]]:
    """Yield the name and the type's name of what the node listens to, publishes and serves, where the code is plain."""
    for path in (PACKAGE / "node").glob("*.py"):
        for node in ast.walk(tree(path)):
            if not isinstance(node, ast.Call) or len(node.args) < 2:
                continue
            called = getattr(node.func, "attr", getattr(node.func, "id", ""))
            kind, name = node.args[:2]
            if called in ("Topic", "create_publisher", "_create") and isinstance(name, ast.Constant):
                assert isinstance(kind, ast.Name)
                yield name.value, kind.id.removesuffix("Message")
