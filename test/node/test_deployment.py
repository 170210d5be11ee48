"""What is shipped beside the code: views for RViz and Foxglove, the security policy, the unit and the container."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import xml.etree.ElementTree as ElementTree
from configparser import ConfigParser
from pathlib import Path

import pytest
import rclpy
import yaml
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.lifecycle import LifecycleNode

from gsfeatloc_ros.ros_io.settings import PARAMETERS

ROOT = Path(__file__).parents[2]
TOPICS = (ROOT / "docs/topics-and-services.md").read_text(encoding="utf-8")
DEPLOYMENT = (ROOT / "docs/deployment.md").read_text(encoding="utf-8")


def table(header: str) -> dict[str, str]:
    """Return names with their types in the table of docs/ whose first column is called `header`."""
    rows = TOPICS.split(f"| {header} | type |")[1].split("\n\n")[0]
    return {name.lstrip("/"): kind for name, kind in re.findall(r"^\| `([^`]+)` \| (\S+) \|", rows, re.MULTILINE)}


SUBSCRIBED, PUBLISHED, SERVICES = table("subscribes"), table("publishes"), table("service")
RVIZ_TYPES = {
    "rviz_default_plugins/PoseWithCovariance": "geometry_msgs/PoseWithCovarianceStamped",
    "rviz_default_plugins/Image": "sensor_msgs/Image",
}


def rviz() -> dict:
    return yaml.safe_load((ROOT / "config/localizer.rviz").read_text(encoding="utf-8"))["Visualization Manager"]


def foxglove() -> dict:
    return json.loads((ROOT / "config/foxglove.json").read_text(encoding="utf-8"))


def test_rviz_shows_what_the_node_publishes():
    shown = {
        display["Topic"]["Value"].lstrip("/"): RVIZ_TYPES[display["Class"]]
        for display in rviz()["Displays"]
        if "Topic" in display
    }
    assert shown == {topic: PUBLISHED[topic] for topic in ("pose", "rendered_image", "debug_image")}


def test_rviz_gives_the_initial_pose():
    (tool,) = (tool for tool in rviz()["Tools"] if tool["Class"] == "rviz_default_plugins/SetInitialPose")
    assert SUBSCRIBED[tool["Topic"]["Value"].lstrip("/")] == "geometry_msgs/PoseWithCovarianceStamped"


def test_the_last_pose_is_shown_when_rviz_comes_late():
    (pose,) = (display for display in rviz()["Displays"] if display["Name"] == "Pose")
    assert pose["Topic"]["Durability Policy"] == "Transient Local"


def leaves(layout: str | dict) -> list[str]:
    if isinstance(layout, str):
        return [layout]
    assert layout["direction"] in ("row", "column")
    assert 0 < layout["splitPercentage"] < 100
    return leaves(layout["first"]) + leaves(layout["second"])


def test_every_foxglove_panel_has_its_place_and_its_settings():
    layout = foxglove()
    assert sorted(leaves(layout["layout"])) == sorted(layout["configById"])


def test_foxglove_shows_what_the_node_publishes():
    panels = foxglove()["configById"]
    images = {panel["imageMode"]["imageTopic"] for name, panel in panels.items() if name.startswith("Image!")}
    assert images == {"/debug_image", "/rendered_image"}
    assert {PUBLISHED[image.lstrip("/")] for image in images} == {"sensor_msgs/Image"}
    assert list(panels["3D!localizer"]["topics"]) == ["/pose"]
    for name in ("DiagnosticSummary!all", "DiagnosticStatusPanel!localizer"):
        assert PUBLISHED[panels[name]["topicToRender"].lstrip("/")] == "diagnostic_msgs/DiagnosticArray"


def test_foxglove_plots_numbers_of_the_pose():
    message = PoseWithCovarianceStamped()
    plots = [panel for name, panel in foxglove()["configById"].items() if name.startswith("Plot!")]
    paths = [series["value"] for plot in plots for series in plot["paths"]]
    assert len(paths) == 9
    for path in paths:
        topic, *fields = path.removesuffix(".@sqrt").split(".")
        assert PUBLISHED[topic.lstrip("/")] == "geometry_msgs/PoseWithCovarianceStamped"
        value = message
        for field in fields:
            name, index = re.fullmatch(r"(\w+)(?:\[(\d+)\])?", field).groups()
            value = getattr(value, name) if index is None else getattr(value, name)[int(index)]
        assert isinstance(value, float)


def test_foxglove_publishes_a_pose_and_calls_the_service():
    panels = foxglove()["configById"]
    for topic in (panels["Publish!initialpose"]["topicName"], panels["3D!localizer"]["publish"]["poseEstimateTopic"]):
        assert SUBSCRIBED[topic.lstrip("/")] == "geometry_msgs/PoseWithCovarianceStamped"
    check_fields(json.loads(panels["Publish!initialpose"]["value"]), PoseWithCovarianceStamped())
    assert panels["CallService!relocalize"]["serviceName"].replace("/localizer/", "~/") in SERVICES
    assert json.loads(panels["CallService!relocalize"]["requestPayload"]) == {}


def check_fields(values: dict, message: object) -> None:
    """The values name all fields of a ROS message, and lists are as long as its arrays."""
    assert set(values) == set(message.get_fields_and_field_types())
    for name, value in values.items():
        if isinstance(value, dict):
            check_fields(value, getattr(message, name))
        elif isinstance(value, list):
            assert len(value) == len(getattr(message, name))


@pytest.fixture(scope="module")
def policy() -> dict[tuple[str, str], set[str]]:
    """Absolute names by kind and direction, of the one profile."""
    (profile,) = ElementTree.parse(ROOT / "config/localizer.policy.xml").getroot().iter("profile")
    assert profile.attrib == {"ns": "/", "node": "localizer"}
    allowed: dict[tuple[str, str], set[str]] = {}
    for group in profile:
        ((direction, rule),) = group.attrib.items()
        assert rule == "ALLOW"
        names = {absolute(entry.text) for entry in group}
        assert len(names) == len(group)
        allowed[group.tag, direction] = names
    return allowed


def absolute(name: str) -> str:
    return "/" + name.replace("~/", "localizer/").lstrip("/")


def test_the_policy_allows_what_the_node_has_and_no_more(policy: dict[tuple[str, str], set[str]]):
    context = rclpy.Context()
    rclpy.init(context=context)
    node = LifecycleNode("localizer", context=context)
    own_topics = {name for name, _ in node.get_publisher_names_and_types_by_node("localizer", "/")}
    own_services = {name for name, _ in node.get_service_names_and_types_by_node("localizer", "/")}
    node.destroy_node()
    rclpy.shutdown(context=context)
    assert {"/rosout", "/localizer/transition_event"} <= own_topics
    assert "/localizer/change_state" in own_services
    assert policy == {
        # Of tf, the clock and the odometry that tf carries there are no rows in the tables.
        ("topics", "subscribe"): {absolute(name) for name in SUBSCRIBED} | {"/odom", "/tf", "/tf_static", "/clock"},
        ("topics", "publish"): {absolute(name) for name in PUBLISHED} | {"/tf"} | own_topics,
        ("services", "reply"): {absolute(name) for name in SERVICES} | own_services,
    }


@pytest.fixture(scope="module")
def unit() -> ConfigParser:
    # A key may stand in a unit more than once, and keys have capitals: only the last is kept, which is enough here.
    parser = ConfigParser(strict=False, interpolation=None, delimiters=("=",), comment_prefixes=("#",))
    parser.optionxform = str
    parser.read(ROOT / "deploy/gsfeatloc-localizer.service", encoding="utf-8")
    return parser


def test_the_unit_starts_the_installed_executable(unit: ConfigParser):
    service = unit["Service"]
    assert service["Restart"] == "on-failure"
    shell, option, script = shlex.split(service["ExecStart"].replace("\\\n", " "))
    assert (shell, option) == ("/bin/bash", "-c")
    subprocess.run(["bash", "-n", "-c", script], check=True)
    assert "exec /opt/gsfeatloc/install/gsfeatloc_ros/lib/gsfeatloc_ros/localizer --ros-args" in script
    for name in re.findall(r"-r (\w+):=", script):
        assert name in SUBSCRIBED
    # The renderer compiles machine code when it starts; the memory that is left is read from /proc/meminfo; the camera
    # driver's shared memory is of the same user.
    assert not {"MemoryDenyWriteExecute", "ProcSubset", "RemoveIPC"} & set(service)


def test_the_unit_is_bounded(unit: ConfigParser):
    service = unit["Service"]
    for name in ("MemoryMax", "TasksMax", "LimitCORE", "UMask", "ProtectProc", "SystemCallFilter", "WatchdogSec"):
        assert service.get(name), name
    assert service["CapabilityBoundingSet"] == ""


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
def test_systemd_understands_the_unit():
    path = ROOT / "deploy/gsfeatloc-localizer.service"
    verified = subprocess.run(["systemd-analyze", "verify", path], capture_output=True, text=True)
    assert (verified.returncode, verified.stderr) == (0, "")
    command = ["systemd-analyze", "security", "--offline=true", "--threshold=15", path]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def test_the_profile_named_is_installed():
    for file in ("gsfeatloc-localizer.service", "Dockerfile"):
        text = (ROOT / "deploy" / file).read_text(encoding="utf-8")
        (path,) = re.findall(r"FASTRTPS_DEFAULT_PROFILES_FILE=(\S+)", text)
        prefix, name = path.split("/share/gsfeatloc_ros/")
        assert prefix == "/opt/gsfeatloc/install/gsfeatloc_ros"
        assert (ROOT / name).is_file()


def test_the_container_copies_what_there_is():
    text = (ROOT / "deploy/Dockerfile").read_text(encoding="utf-8")
    copies = [line.split()[1:] for line in text.splitlines() if line.startswith("COPY")]
    sources = {word for words in copies for word in words[:-1] if not word.startswith("--")}
    assert sources >= {"setup.py", "package.xml", "setup.cfg", "resource", "config", "gsfeatloc_ros", "interfaces"}
    for source in sources:
        assert (ROOT / source).exists(), source


def test_the_entrypoint_runs():
    entrypoint = ROOT / "deploy/entrypoint.sh"
    assert entrypoint.stat().st_mode & 0o111
    subprocess.run(["bash", "-n", entrypoint], check=True)


def test_the_guide_names_parameters_that_there_are():
    names = {parameter.name for parameter in PARAMETERS} | {"use_sim_time"}
    blocks = [yaml.safe_load(block) for block in re.findall(r"```yaml\n(.*?)```", DEPLOYMENT, re.DOTALL)]
    given = [block["localizer"]["ros__parameters"] for block in blocks if "localizer" in block]
    assert given
    for parameters in given:
        assert flat(parameters).keys() <= names
    on_command_lines = re.findall(r"-p ([\w.]+):=", DEPLOYMENT)
    assert on_command_lines
    assert set(on_command_lines) <= names


def flat(parameters: dict, prefix: str = "") -> dict[str, object]:
    values = {}
    for name, value in parameters.items():
        values |= flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return values


def test_links_of_the_guide_lead_somewhere():
    links = [link for link in re.findall(r"\]\(([^)#]+)\)", DEPLOYMENT) if "://" not in link]
    assert links
    for link in links:
        assert (ROOT / "docs" / link).exists(), link
