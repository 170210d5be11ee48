"""A real map that lies anywhere, aligned by a simulated drive on its real photos."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from drives import Errors, as_pairs, random_similarity, write_tum

from gsfeatloc_ros.common.geometry import quaternion_from_matrix, so3_exp, so3_log
from gsfeatloc_ros.common.parameter import settings_from
from gsfeatloc_ros.evaluate.scene import load_scene
from gsfeatloc_ros.localize.engine import load_engine
from gsfeatloc_ros.localize.options import LocalizerOptions
from gsfeatloc_ros.localize.settings import MapSettings, MatcherSettings, RendererSettings
from gsfeatloc_ros.maps import Similarity
from gsfeatloc_ros.ros_io.parameter_file import read_parameter_file
from gsfeatloc_ros.tools.align import main

PHOTOS = 20


def localized(scene, map_: MapSettings, S_frame_scene: Similarity, rng: np.random.Generator) -> np.ndarray:
    """Return T_frame_camera (N, 4, 4) of the photos, in the frame where the map lies, from priors that are off."""
    # A fifteenth of the trajectory's radius, in the unit of this frame.
    off = 0.25 * S_frame_scene.scale
    options = LocalizerOptions(prior_translation=2 * off)
    localizer = load_engine(map_, MatcherSettings(), RendererSettings(), options).localizer
    poses = []
    for photo in scene.photos[:PHOTOS]:
        prior = S_frame_scene.transform_pose(photo.T_map_camera)
        prior[:3, :3] = prior[:3, :3] @ so3_exp(rng.normal(0, np.radians(4), 3))
        prior[:3, 3] += rng.normal(0, off / np.sqrt(3), 3)
        estimate = localizer.localize(scene.read_photo(photo), photo.camera, prior)
        assert estimate.localized, estimate.reason
        poses.append(estimate.T_map_camera)
    return np.array(poses)


def errors(poses: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return degrees and distances (N, 2) between poses."""
    turns = [so3_log(a[:3, :3].T @ b[:3, :3]) for a, b in zip(poses, truth, strict=True)]
    distances = np.linalg.norm(poses[:, :3, 3] - truth[:, :3, 3], axis=1)
    return np.column_stack([np.degrees(np.linalg.norm(turns, axis=1)), distances])


@pytest.mark.nightly
@pytest.mark.parametrize("seed", [0, 1])
def test_a_drive_through_bonsai_gives_the_robots_frame(scenes, seed, tmp_path):
    scene, rng = load_scene(scenes / "bonsai"), np.random.default_rng(seed)
    # Where the map lies before, and where it has to lie: the radius of the drive is 1.9 m.
    now = replace(random_similarity(rng), scale=float(rng.uniform(0.5, 2)))
    S_robot_scene = replace(random_similarity(rng), scale=0.5)
    place = {"translation": tuple(now.translation), "rotation": tuple(quaternion_from_matrix(now.rotation))}
    map_ = MapSettings(path=str(scene.map_path), scale=now.scale, cache=False, **place)
    truth = np.array([S_robot_scene.transform_pose(photo.T_map_camera) for photo in scene.photos[:PHOTOS]])

    answers = localized(scene, map_, now, rng)
    odometry = as_pairs(truth, Similarity(), Errors(position=0.01, rotation=0.5, step=0.01), rng).references
    arguments = ["trajectory", "--answers", str(write_tum(tmp_path / "answers.tum", answers))]
    arguments += ["--trajectory", str(write_tum(tmp_path / "odometry.tum", odometry)), "--map", str(scene.map_path)]
    arguments += ["--map-scale", f"{now.scale!r}", "--map-translation", *(f"{x:.9f}" for x in place["translation"])]
    arguments += ["--map-rotation", *(f"{x:.9f}" for x in place["rotation"]), "--out", str(tmp_path / "map.yaml")]
    assert main(arguments) == 0

    found = settings_from(MapSettings, read_parameter_file(tmp_path / "map.yaml"), "map.")
    off = found.alignment() @ S_robot_scene.inverse()
    print("scale off by", off.scale - 1, "angle", np.degrees(np.linalg.norm(so3_log(off.rotation))))
    assert off.scale == pytest.approx(1, abs=0.005)
    assert np.degrees(np.linalg.norm(so3_log(off.rotation))) < 0.5
    # As accurate as before: the same photos in the new frame, against where the map puts the truth there.
    again = localized(scene, replace(found, cache=False), found.alignment(), rng)
    placed = np.array([found.alignment().transform_pose(photo.T_map_camera) for photo in scene.photos[:PHOTOS]])
    before = errors(answers, np.array([now.transform_pose(photo.T_map_camera) for photo in scene.photos[:PHOTOS]]))
    after = errors(again, placed)
    print(
        "before", np.median(before / [1, now.scale], axis=0), "after", np.median(after / [1, off.scale * 0.5], axis=0)
    )
    print("against the robot's truth", np.median(errors(again, truth), axis=0))
    np.testing.assert_allclose(np.median(after, 0) / [1, found.scale], np.median(before, 0) / [1, now.scale], rtol=0.5)
    # The odometry has drifted by about as much.
    assert np.median(errors(again, truth)[:, 1]) < 0.05
