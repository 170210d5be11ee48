"""docs/topics-and-services.md names what the installed localizer has in the graph, with its types, and no more."""

from __future__ import annotations

import re
import time
from pathlib import Path

import pytest
import rclpy
from node_harness import running_localizer
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node, NodeNameNonExistentError

PAGE = (Path(__file__).parents[2] / "docs/topics-and-services.md").read_text(encoding="utf-8")
# tf2_ros makes it, where publish_tf asks for it.
OF_TF = {"/tf": "tf2_msgs/TFMessage"}
# Seconds.
DISCOVERY = 10.0

Names = dict[str, str]


def table(header: str) -> Names:
    """Return the absolute names and the types of the table whose first column is called `header`."""
    text = PAGE.split(f"| {header} | type |")[1].split("\n\n")[0]
    rows = re.findall(r"^\| `([^`]+)` \| (\S+) \|", text, re.MULTILINE)
    return {"/" + name.replace("~/", "localizer/").lstrip("/"): short(kind) for name, kind in rows}


def short(kind: str) -> str:
    return kind.replace("/msg/", "/").replace("/srv/", "/")


def named(node: Node, kind: str, name: str) -> Names:
    """Return what a node of the graph has: its `publisher`s, `subscriber`s or `service`s."""
    try:
        found = getattr(node, f"get_{kind}_names_and_types_by_node")(name, "/")
    except NodeNameNonExistentError:
        return {}
    return {topic: short(only) for topic, (only,) in found}


@pytest.fixture(scope="module")
def bare():
    """A node that has what any lifecycle node has; one: of a second of its name, rclpy loses sight of /rosout."""
    context = rclpy.Context()
    rclpy.init(context=context)
    node = LifecycleNode("bare", context=context)
    yield node
    node.destroy_node()
    rclpy.shutdown(context=context)


@pytest.mark.parametrize(("transport", "image"), [("raw", "/image"), ("compressed", "/image/compressed")])
def test_the_page_names_all_that_the_node_has(bare, room_map_file, transport, image):
    """And what any lifecycle node has. Without track and map.aligned there is neither odometry nor ~/occupancy."""
    subscribed, published = table("subscribes"), table("publishes")
    assert OF_TF.items() <= published.items()
    other_image = ({"/image", "/image/compressed"} - {image}).pop()
    listed = {
        "subscriber": {name: kind for name, kind in subscribed.items() if name != other_image},
        "publisher": {name: kind for name, kind in published.items() if name not in OF_TF},
        "service": table("service"),
    }

    def expected(kind: str) -> Names:
        of_any = named(bare, kind, "bare")
        return listed[kind] | {name.replace("/bare/", "/localizer/"): of for name, of in of_any.items()}

    parameters = {"track": True, "map__aligned": True, "image__transport": transport}
    with running_localizer(map__path=room_map_file, **parameters):
        for kind in listed:
            deadline = time.monotonic() + DISCOVERY
            while named(bare, kind, "localizer") != expected(kind) and time.monotonic() < deadline:
                time.sleep(0.1)
            assert named(bare, kind, "localizer") == expected(kind)
