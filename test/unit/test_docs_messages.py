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


@functools.cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def texts(room: str) -> set[str]:
    """Return the texts in the sources of a room, with … for what is put in."""
    found = set()
    for path in (PACKAGE / room).rglob("*.py"):
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.JoinedStr):
                found.add("".join(part.value if isinstance(part, ast.Constant) else "…" for part in node.values))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.add(node.value)
    return found


def test_messages_are_those_of_the_code() -> None:
    page = (ROOT / "docs/troubleshooting.md").read_text(encoding="utf-8")
    messages = re.findall(r"^\| `([^`]+)` \|", page, re.MULTILINE) + re.findall(r"says `([^`]+)`", page)
    assert len(messages) > 30
    said = set().union(*(texts(room) for room in ("common", "localize", "maps", "node", "render", "ros_io")))
    missing = [message for message in messages if not any(message.strip("… ") in text for text in said)]
    assert not missing


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
