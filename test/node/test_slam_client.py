"""A SLAM stack (slam_client.py) that loses track gets its pose back from the installed localizer."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rclpy
from node_harness import running_localizer

from gsfeatloc_ros.common.geometry import rotation_error_deg, translation_error

REASON = "gsfeatloc_interfaces is not built: there is no ~/localize_image"
LocalizeImage = pytest.importorskip("gsfeatloc_interfaces.srv", reason=REASON).LocalizeImage

from slam_client import STEPS, journey  # noqa: E402 - it needs that package

SCRIPT = Path(__file__).parents[2] / "examples" / "slam_client.py"


def run_stack(out: Path, *arguments: str) -> tuple[int, dict]:
    """Exit status of the script, and what it did."""
    command = [sys.executable, SCRIPT, "--json", out, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=400)
    assert done.stderr == "", done.stderr
    return done.returncode, json.loads(out.read_text())


@pytest.fixture(scope="module")
def localizer(room_map_file):
    with running_localizer(map__path=room_map_file) as process:
        yield process


# The states of a stack that nobody helps, until it gives up.
LOST = ["TRACKING"] * STEPS + ["LOST"] * 2


def test_without_a_localizer_it_stays_lost(tmp_path):
    status, did = run_stack(tmp_path / "slam.json", "--timeout", "0.2")
    assert status == 1
    assert [pose["state"] for pose in did["poses"]] == LOST
    assert did["log"][-1]["text"] == "nobody serves /localizer/localize_image"


def test_without_an_answer_it_stays_lost(tmp_path):
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("deaf", context=context)
    # Nobody spins this node.
    node.create_service(LocalizeImage, "deaf/localize_image", print)
    try:
        status, did = run_stack(tmp_path / "slam.json", "--timeout", "1.0", "--service", "/deaf/localize_image")
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)
    assert status == 1
    assert [pose["state"] for pose in did["poses"]] == LOST
    assert "no answer in time" in [entry["text"] for entry in did["log"]]
    assert not any("status" in entry for entry in did["log"])


@pytest.fixture(scope="module", params=[0, pytest.param(1, marks=pytest.mark.nightly)])
def journey_made(request, localizer, tmp_path_factory):
    """Seed of the journey, and what the stack did on it."""
    status, did = run_stack(tmp_path_factory.mktemp("slam") / "slam.json", "--seed", str(request.param))
    assert status == 0, did["log"]
    return request.param, did


def test_it_loses_track_gets_its_pose_back_and_goes_on(journey_made):
    seed, did = journey_made
    expected = ["TRACKING"] * STEPS + ["LOST"] + ["TRACKING"] * STEPS
    assert [pose["state"] for pose in did["poses"]] == expected, did["log"]
    truth = [pose for _, pose in journey(seed)]
    assert [pose["phase"] for pose in did["poses"]] == [phase for phase, _ in journey(seed)]
    # It had to be told: what it thought before was far off.
    asked_from, was_at = np.array(did["poses"][STEPS]["T_map_camera"]), truth[STEPS + 1]
    assert translation_error(asked_from, was_at) > 0.3 or rotation_error_deg(asked_from, was_at) > 20.0
    found = np.array(did["poses"][STEPS + 1]["T_map_camera"])
    assert translation_error(found, was_at) < 0.02
    assert rotation_error_deg(found, was_at) < 1.0
    # From there its own odometry leads it on.
    for pose, true in zip(did["poses"][STEPS + 2 :], truth[STEPS + 2 :], strict=True):
        assert translation_error(np.array(pose["T_map_camera"]), true) < 0.03
        assert rotation_error_deg(np.array(pose["T_map_camera"]), true) < 1.0


def test_noise_is_answered_with_a_reason_and_not_believed(journey_made):
    _, did = journey_made
    answers = [entry for entry in did["log"] if "status" in entry]
    assert answers[0]["status"] in ("FAILED", "REJECTED")
    assert answers[0]["state"] == "LOST"
    assert answers[0]["text"].partition(": ")[2]
    assert [entry["status"] for entry in answers].count("LOCALIZED") == 1
    assert answers[-1]["status"] == "LOCALIZED"
