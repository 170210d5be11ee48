"""Negatives: what they are, what is said of them, and the tool."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from room_datasets import write_nerfstudio

from gsfeatloc_ros.common.geometry import make_pose
from gsfeatloc_ros.evaluate.negatives import (
    NEGATIVES,
    NegativeOptions,
    NegativeResult,
    draw_negatives,
    negative_table,
)
from gsfeatloc_ros.evaluate.protocol import PROTOCOLS
from gsfeatloc_ros.evaluate.scene import load_scene
from gsfeatloc_ros.localize.estimate import Estimate, Status
from gsfeatloc_ros.localize.evidence import Evidence
from gsfeatloc_ros.simulate import simulate_photos
from gsfeatloc_ros.tools import negatives, strangers


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory, room, room_camera, room_map_file) -> Path:
    camera = room_camera.scaled(320, 240)
    photos = simulate_photos(room, camera, count=3, seed=5)
    return write_nerfstudio(tmp_path_factory.mktemp("room"), camera, photos, room_map_file)


def test_negatives_are_of_every_kind_with_the_priors_of_the_paper(scene_folder):
    scene = load_scene(scene_folder)
    options = NegativeOptions(sigma=0.5, seed=3, limit=2)
    drawn = {kind: draw_negatives(scene, kind, options) for kind in NEGATIVES}
    drawn[scene.name] = draw_negatives(scene, scene, options)
    for kind, negatives_ in drawn.items():
        assert [negative.kind for negative in negatives_] == [kind] * 2
        for index, negative in enumerate(negatives_):
            assert negative.prior.photo == index
            assert negative.camera is scene.photos[index].camera
            assert negative.read().shape == (negative.camera.height, negative.camera.width, 3)
            np.testing.assert_array_equal(negative.read(), negative.read())
    image, priors = scene.read_photo(scene.photos[0]), PROTOCOLS["paper"](scene, 0.5, 3)
    np.testing.assert_array_equal(drawn["mirrored"][0].read(), image[:, ::-1])
    np.testing.assert_array_equal(drawn["upside-down"][0].read(), image[::-1])
    np.testing.assert_array_equal(drawn["mirror-pose"][0].read(), image[:, ::-1])
    np.testing.assert_array_equal(drawn[scene.name][0].read(), image)
    assert drawn["noise"][0].read().std() > 70
    assert (drawn["noise"][0].read() != drawn["noise"][1].read()).any()
    assert not drawn["black"][0].read().any()
    # Every second of the own photos is looked for where it was taken.
    for kind in ("mirrored", "upside-down"):
        np.testing.assert_array_equal(drawn[kind][0].prior.T_map_camera, scene.photos[0].T_map_camera)
    for kind in ("mirrored", "upside-down", "noise", "black", scene.name):
        np.testing.assert_array_equal(drawn[kind][1].prior.T_map_camera, priors[1].T_map_camera)
        np.testing.assert_array_equal(drawn[kind][1].prior.covariance, priors[1].covariance)


def test_a_mirror_pose_is_on_the_opposite_side_and_looks_back(scene_folder):
    scene = load_scene(scene_folder)
    # Two upright cameras that look at each other, along z; y points down.
    here, there = make_pose(np.eye(3), np.array([1.0, 0.5, -2.0])), make_pose(np.diag([-1.0, 1, -1]), np.zeros(3))
    there[:3, 3] = [1.0, 0.5, 4.0]
    scene = replace(scene, photos=(replace(scene.photos[0], T_map_camera=here),), trajectory=np.array([here, there]))
    (negative,) = draw_negatives(scene, "mirror-pose", NegativeOptions())
    np.testing.assert_allclose(negative.prior.T_map_camera, there, atol=1e-12)
    np.testing.assert_array_equal(negative.prior.covariance, PROTOCOLS["paper"](scene, 1.0, 0)[0].covariance)


def result(status: Status, kind: str = "noise", seconds: float = 1.0) -> NegativeResult:
    pose = np.eye(4) if status is Status.LOCALIZED else None
    return NegativeResult("room", "sift", kind, "a.png", Estimate(status, "why", pose), seconds)


def test_a_row_has_all_of_the_evidence():
    row = result(Status.FAILED, seconds=0.12345).row()
    assert list(row) == ["scene", "matcher", "kind", "photo", "status", "reason", *Evidence().numbers(), "cpu_seconds"]
    assert (row["status"], row["inliers"], row["correlation"], row["cpu_seconds"]) == ("failed", 0, None, 0.123)
    assert json.loads(json.dumps(row, allow_nan=False)) == row


def test_table_counts_by_kind_and_poses_in_all():
    results = [result(Status.FAILED), result(Status.REJECTED), result(Status.FAILED, seconds=3.0)]
    lines = negative_table([*results, result(Status.LOCALIZED, "black")]).splitlines()
    assert lines[1].split() == ["sift", "room", "noise", "3", "0", "0", "1", "2", "1.00"]
    assert lines[2].split() == ["sift", "room", "black", "1", "1", "0", "0", "0", "1.00"]
    assert lines[3] == "accepted 1 of 4"


@pytest.mark.slow
@pytest.mark.parametrize("sigma", ["0.02", pytest.param("0.3", marks=pytest.mark.nightly)])
def test_tool_gives_no_negative_a_pose(scene_folder, tmp_path, capsys, sigma):
    path = tmp_path / "negatives.json"
    assert negatives.main([str(scene_folder), "--sigma", sigma, "--limit", "1", "--json", str(path)]) == 0
    rows = json.loads(path.read_text())
    assert [(row["kind"], row["photo"]) for row in rows] == [
        ("mirrored", "0.png"),
        ("upside-down", "0.png"),
        ("mirror-pose", "0.png"),
        ("noise", "noise 0"),
        ("black", "black 0"),
    ]
    assert {row["status"] for row in rows} <= {"failed", "rejected"}
    assert capsys.readouterr().out.splitlines()[-1] == "accepted 0 of 5"


def test_the_old_name_of_the_tool_works_with_a_notice(tmp_path, capsys):
    assert strangers.main([str(tmp_path)]) == 2
    notice, error = capsys.readouterr().err.splitlines()
    assert notice == "tools.strangers is now tools.negatives; the old name works until the next release"
    assert error.startswith(f"negatives: {tmp_path}: holds none of ")


def test_tool_says_what_cannot_be_used(tmp_path, capsys):
    assert negatives.main([str(tmp_path)]) == 2
    assert "negatives: " in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        negatives.main([str(tmp_path), "--matcher", "sift,magic"])
    assert "magic is not one of sift" in capsys.readouterr().err
