"""docs/topics-and-services.md names what the installed localizer has in the graph, with its types, and no more."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import rclpy
from node_harness import TIMEOUT, NodeProcess, node_arguments
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node, NodeNameNonExistentError

PAGE = (Path(__file__).parents[2] / "docs/topics-and-services.md").read_text(encoding="utf-8")
# tf2_ros makes it, where publish_tf asks for it.
OF_TF = {"/tf": "tf2_msgs/TFMessage"}

Names = dict[str, str]


def table(header: str, node: str) -> Names:
    """Return the names and the types, of a node called so, of the table whose first column is called `header`."""
    text = PAGE.split(f"| {header} | type |")[1].split("\n\n")[0]
    rows = re.findall(r"^\| `([^`]+)` \| (\S+) \|", text, re.MULTILINE)
    return {"/" + name.replace("~/", f"{node}/").lstrip("/"): short(kind) for name, kind in rows}


def short(kind: str) -> str:
    return kind.replace("/msg/", "/").replace("/srv/", "/")


def named(node: Node, kind: str, name: str) -> Names:
    """Return what a node of the graph has: its `publisher`s, `subscriber`s or `service`s."""
    try:
        found = getattr(node, f"get_{kind}_names_and_types_by_node")(name, "/")
    except NodeNameNonExistentError:
        return {}
    return {topic: short(only) for topic, (only,) in found}


@contextmanager
def bare_node(name: str) -> Iterator[Node]:
    """A node that has what any lifecycle node has, in a context of its own that knows no earlier localizer.

    Its name must be new to this process: of a second node of the same name, rclpy loses sight of /rosout.
    """
    context = rclpy.Context()
    rclpy.init(context=context)
    node = LifecycleNode(name, context=context)
    yield node
    node.destroy_node()
    rclpy.shutdown(context=context)


@pytest.mark.parametrize(("transport", "image"), [("raw", "/image"), ("compressed", "/image/compressed")])
def test_the_page_names_all_that_the_node_has(room_map_file, transport, image):
    """And what any lifecycle node has. Without track and map.aligned there is neither odometry nor ~/occupancy."""
    # No other test's: rclpy leaves the name of a node that was destroyed in the graph while anything holds the object,
    # and a node without topics would be found under it.
    name, bare_name = f"{transport}_localizer", f"{transport}_bare"
    subscribed, published = table("subscribes", name), table("publishes", name)
    assert OF_TF.items() <= published.items()
    other_image = ({"/image", "/image/compressed"} - {image}).pop()
    listed = {
        "subscriber": {topic: kind for topic, kind in subscribed.items() if topic != other_image},
        "publisher": {topic: kind for topic, kind in published.items() if topic not in OF_TF},
        "service": table("service", name),
    }

    def expected(bare: Node, kind: str) -> Names:
        of_any = named(bare, kind, bare_name)
        return listed[kind] | {topic.replace(f"/{bare_name}/", f"/{name}/"): of for topic, of in of_any.items()}

    parameters = {"map__path": room_map_file, "track": True, "map__aligned": True, "image__transport": transport}
    localizer = NodeProcess(*node_arguments(**parameters), "-r", f"__node:={name}")
    try:
        localizer.wait_until_ready()
        with bare_node(bare_name) as bare:
            for kind in listed:
                deadline = time.monotonic() + TIMEOUT
                while named(bare, kind, name) != expected(bare, kind) and time.monotonic() < deadline:
                    time.sleep(0.1)
                assert named(bare, kind, name) == expected(bare, kind)
    finally:
        localizer.end()
