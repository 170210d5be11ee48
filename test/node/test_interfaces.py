"""The typed service and message, as they are built from interfaces/, and how they are built."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import rclpy
from ament_index_python.packages import get_package_share_directory
from gsfeatloc_interfaces.msg import ProtectionLevel
from gsfeatloc_interfaces.srv import LocalizeImage
from node_harness import connected_client, running_localizer, send_inputs
from rclpy.executors import SingleThreadedExecutor
from rclpy.serialization import deserialize_message, serialize_message

from gsfeatloc_ros.client.messages import rgb_image
from gsfeatloc_ros.localize.protection import RISK

ROOT = Path(__file__).parents[2]
STATUSES = {"LOCALIZED": 0, "REJECTED": 1, "FAILED": 2, "REFUSED": 3, "ERROR": 4, "AMBIGUOUS": 5, "BUSY": 6}


def test_request_has_the_fields():
    assert LocalizeImage.Request.get_fields_and_field_types() == {
        "image": "sensor_msgs/Image",
        "camera_info": "sensor_msgs/CameraInfo",
        "has_prior": "boolean",
        "prior": "geometry_msgs/PoseWithCovarianceStamped",
        "max_seconds": "double",
        "forget": "boolean",
    }


def test_response_has_the_fields():
    assert LocalizeImage.Response.get_fields_and_field_types() == {
        "status": "uint8",
        "reason": "string",
        "pose": "geometry_msgs/PoseWithCovarianceStamped",
        "candidates": "geometry_msgs/PoseArray",
        "probability_wrong": "double",
        "protection_radius": "double",
        "protection_angle": "double",
        "inliers": "uint32",
        "milliseconds": "double",
    }


def test_statuses_are_constants_of_the_response():
    assert {name: getattr(LocalizeImage.Response, name) for name in STATUSES} == STATUSES


def test_protection_level_has_the_fields():
    assert ProtectionLevel.get_fields_and_field_types() == {
        "header": "std_msgs/Header",
        "radius": "double",
        "angle": "double",
        "risk": "double",
    }
    assert ProtectionLevel().risk == RISK


def test_empty_request_has_no_prior_and_heals_the_stream():
    request = deserialize_message(serialize_message(LocalizeImage.Request()), LocalizeImage.Request)
    assert not request.has_prior
    assert not request.forget
    assert request.max_seconds == 0
    assert len(request.image.data) == 0
    assert not np.any(request.prior.pose.covariance)


def test_service_answers_over_dds():
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("interfaces", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)

    def answer(request: LocalizeImage.Request, response: LocalizeImage.Response) -> LocalizeImage.Response:
        response.status = LocalizeImage.Response.REFUSED
        response.reason = f"{len(request.image.data)} bytes, {request.image.encoding}"
        response.pose = request.prior
        return response

    try:
        node.create_service(LocalizeImage, "localize_image", answer)
        client = node.create_client(LocalizeImage, "localize_image")
        assert client.wait_for_service(30.0)
        request = LocalizeImage.Request(has_prior=True)
        request.image.data, request.image.encoding = bytes(1920 * 1080 * 3), "rgb8"
        request.prior.pose.covariance = np.arange(36.0)
        future = client.call_async(request)
        executor.spin_until_future_complete(future, 30.0)
        response = future.result()
        assert response.status == LocalizeImage.Response.REFUSED
        assert response.reason == "6220800 bytes, rgb8"
        assert response.pose.pose.covariance.tolist() == list(range(36))
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown(context=context)


@pytest.mark.parametrize("file", ["msg/ProtectionLevel.msg", "srv/LocalizeImage.srv"])
def test_files_are_installed_with_their_comments(file):
    installed = Path(get_package_share_directory("gsfeatloc_interfaces")) / file
    assert installed.read_text() == (ROOT / "interfaces" / file).read_text()


def test_manifest_agrees_with_that_of_the_node():
    node, interfaces = (ElementTree.parse(ROOT / folder / "package.xml").getroot() for folder in ("", "interfaces"))
    for tag in ("version", "license", "maintainer"):
        assert interfaces.findtext(tag) == node.findtext(tag)
    assert interfaces.find("maintainer").get("email") == node.find("maintainer").get("email")


def test_the_node_runs_without_them(monkeypatch, room_map_file, room_camera, photo):
    paths = os.environ["PYTHONPATH"].split(os.pathsep)
    kept = [path for path in paths if not (Path(path) / "gsfeatloc_interfaces").exists()]
    assert len(kept) < len(paths)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(kept))
    with running_localizer(map__path=room_map_file) as process, connected_client() as client:
        assert "~/localize_image and the topic protection_level are off: build" in process.output
        send_inputs(client, room_camera, photo)
        image = rgb_image(photo.image)
        answer = client.attempt(image)
        assert answer.ok, answer
        assert client.pose_of(image) is not None
        # It is on /diagnostics all the same.
        assert float(answer.values["protection_radius"]) > 0
        assert client.node.count_publishers("protection_level") == 0


def built(root: Path, tools: list[str], headers: bool = True, **environment: str) -> subprocess.CompletedProcess:
    """What scripts/build.sh gives to colcon (printed, not done) where there are these tools, and Python's headers."""
    shutil.copytree(ROOT / "scripts", root / "scripts")
    programs = root / ".venv" / "bin"
    programs.mkdir(parents=True)
    (programs / "activate").write_text(f"export VIRTUAL_ENV={root}/.venv PATH={programs}\n")
    # Says yes when asked for rclpy, and prints what it is to do otherwise.
    answers = f"*Python.h*) exit {int(not headers)};; -c*) exit 0;; *) echo $*;;"
    (programs / "python").write_text(f'#!/bin/sh\ncase "$*" in {answers} esac\n')
    (programs / "python").chmod(0o755)
    for tool in ["bash", "dirname", *tools]:
        (programs / tool).symlink_to(shutil.which(tool))
    return subprocess.run(
        [root / "scripts" / "build.sh"], env={"PATH": str(programs), **environment}, capture_output=True, text=True
    )


def test_interfaces_are_built_with_the_package(tmp_path):
    done = built(tmp_path, ["cmake", "c++"])
    assert done.returncode == 0, done.stderr
    assert "colcon build --base-paths . interfaces test/support/tf2_msgs --cmake-args" in done.stdout
    assert done.stderr == ""


def test_the_tests_own_tf2_msgs_is_not_built_over_that_of_an_install(tmp_path):
    done = built(tmp_path, ["cmake", "c++"], ROS_DISTRO="jazzy", AMENT_PREFIX_PATH="/opt/ros/jazzy")
    assert "colcon build --base-paths . interfaces --cmake-args" in done.stdout


@pytest.mark.parametrize(
    ("tools", "headers"), [([], True), (["cmake"], True), (["c++"], True), (["cmake", "c++"], False)]
)
def test_where_nothing_can_be_compiled_only_the_package_is_built(tmp_path, tools, headers):
    done = built(tmp_path, tools, headers)
    assert done.returncode == 0
    assert "colcon build --base-paths . --cmake-args" in done.stdout
    assert done.stderr.count("\n") == 1
    assert "the service ~/localize_image is off" in done.stderr
    assert "apt install cmake g++ python3-dev" in done.stderr
