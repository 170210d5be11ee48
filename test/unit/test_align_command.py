"""The command line of align: files and bags in, the node's parameters out, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bags import CAMERA_FRAME, TOPICS, camera_info, image, odometry, pose_stamped, transform, transforms, write_messages
from drives import Errors, as_pairs, curve, line, random_similarity, write_tum

from gsfeatloc_ros.align.pose_files import read_answers, read_tum
from gsfeatloc_ros.common.geometry import invert, make_pose, quaternion_from_matrix, so3_exp, so3_log
from gsfeatloc_ros.common.parameter import settings_from
from gsfeatloc_ros.localize.settings import MapSettings
from gsfeatloc_ros.maps.similarity import Similarity
from gsfeatloc_ros.ros_io.parameter_file import read_parameter_file
from gsfeatloc_ros.ros_io.settings import Settings
from gsfeatloc_ros.tools.align import main

# Of the camera on a robot: 20 cm ahead, 40 cm up, looking ahead.
T_BASE_CAMERA = make_pose([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0.2, 0.0, 0.4])


def placed_by(path: Path) -> Similarity:
    """Return where a parameter file says that the map lies, as the node reads it."""
    values = read_parameter_file(path)
    Settings.checked(values)
    return settings_from(MapSettings, values, "map.").alignment()


def options_of(map_: Similarity) -> list[str]:
    numbers = [*map_.translation, *quaternion_from_matrix(map_.rotation)]
    texts = [f"{value:.12f}" for value in numbers]
    return ["--map-scale", f"{map_.scale:.12f}", "--map-translation", *texts[:3], "--map-rotation", *texts[3:]]


def far(a: Similarity, b: Similarity) -> tuple[float, float]:
    """Return how far two similarities are apart: of the scale, and degrees."""
    off = a @ b.inverse()
    return abs(off.scale - 1), float(np.degrees(np.linalg.norm(so3_log(off.rotation))))


@pytest.fixture
def files(tmp_path):
    """Answers in a map that lies elsewhere already, the odometry of their camera, and the truth."""
    rng = np.random.default_rng(1)
    now, truth = random_similarity(rng), random_similarity(rng)
    pairs = as_pairs(curve(), truth @ now.inverse(), Errors(0.01, 0.5, 0.01), rng)
    answers = write_tum(tmp_path / "answers.tum", pairs.answers)
    odometry_file = write_tum(tmp_path / "odometry.tum", pairs.references)
    arguments = ["trajectory", "--answers", str(answers), "--trajectory", str(odometry_file), *options_of(now)]
    return [*arguments, "--map", "/maps/room.ply", "--out", str(tmp_path / "map.yaml")], truth, tmp_path / "map.yaml"


def test_the_node_reads_what_is_written(files, capsys):
    arguments, truth, out = files
    assert main(arguments) == 0
    scale, degrees = far(placed_by(out), truth)
    assert scale < 0.005
    assert degrees < 0.5
    values = read_parameter_file(out)
    assert values["map.aligned"] is True
    assert values["map.path"] == "/maps/room.ply"
    said = capsys.readouterr().out
    assert "20 of 20 photos agree" in said
    comments = [text for text in out.read_text().splitlines() if text.startswith("#")]
    assert any("residuals of positions" in text for text in comments)


def test_a_line_without_orientations_writes_nothing(files, tmp_path, capsys):
    arguments, _, out = files
    rng = np.random.default_rng(1)
    pairs = as_pairs(line(), random_similarity(rng), Errors(0.01, 0.5), rng)
    write_tum(tmp_path / "answers.tum", pairs.answers)
    write_tum(tmp_path / "odometry.tum", pairs.references)
    assert main([*arguments, "--positions-only"]) == 1
    assert not out.exists()
    said = capsys.readouterr().err
    assert "this drive does not tell the turn about" in said
    assert said.count("\n") == 1


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("", "is empty"),
        ("# nothing\n", "holds no pose"),
        ("100.0 1 2 3 0 0 0\n", "line 1 is not"),
        ("100.0 1 2 3 0 0 0 0\n", "line 1 is not"),
        ("100.0 1 nan 3 0 0 0 1\n", "line 1 is not"),
        ("1e400 1 2 3 0 0 0 1\n", "line 1 is not"),
        ("photo.jpg 1 2 3 0 0 0 1\n", "line 1 is not"),
        ("stamp,x,y\n100.0,1,2\n", "line 2 is not"),
    ],
)
def test_files_that_hold_no_poses(files, tmp_path, content, complaint, capsys):
    (tmp_path / "answers.tum").write_text(content)
    assert main(files[0]) == 2
    said = capsys.readouterr().err
    assert complaint in said
    assert said.count("\n") == 1


def test_what_cannot_be_used_is_told_in_one_line(files, tmp_path, capsys):
    arguments, _, out = files
    for changed, complaint in [
        ([*arguments, "--answers", str(tmp_path / "none.tum")], "none.tum: cannot be read"),
        ([*arguments, "--extrinsics", *"0000000"], "--extrinsics: quaternion"),
        ([*arguments, "--out", str(tmp_path)], "name another file"),
        ([*arguments, "--map-scale", "0"], "map.scale: 0.0"),
        (["drive", str(tmp_path), "--image", "/image", "--out", str(out)], "--map"),
    ]:
        assert main(changed) == 2, complaint
        said = capsys.readouterr().err
        assert complaint in said
        assert said.count("\n") == 1


def test_answers_of_replay_bring_their_variances(tmp_path):
    path = tmp_path / "answers.csv"
    path.write_text(
        "stamp,status,x,y,z,qx,qy,qz,qw,var_x,var_y,var_z,var_rx,var_ry,var_rz\n"
        "100.000000001,localized,1,2,3,0,0,0,1,1e-4,2e-4,3e-4,1e-6,1e-6,1e-6\n101.0,failed,,,,,,,,,,,,,\n"
    )
    (answer,) = read_answers(path)
    assert answer.stamp == 100_000_000_001
    assert answer.T_map_camera[:3, 3].tolist() == [1, 2, 3]
    np.testing.assert_allclose(answer.variances, [2e-4, 1e-6])


def robot_bag(path: Path, poses: np.ndarray, images: list, tf: bool) -> Path:
    """Write a robot's drive at the stamps 100, 101, ...: odometry or tf, where its camera sits, and images."""
    sits = transforms(transform(0.0, "base_link", CAMERA_FRAME, T_BASE_CAMERA))
    messages = [("/tf_static", sits), *images]
    for number in range(5 * (len(poses) - 1) + 1):
        stamp = 100.0 + number / 5
        turn = so3_exp(so3_log(poses[number // 5][:3, :3].T @ poses[-(-number // 5)][:3, :3]) * (number % 5) / 5)
        between = (number % 5 * poses[-(-number // 5)] + (5 - number % 5) * poses[number // 5]) / 5
        T_odom_base = make_pose(poses[number // 5][:3, :3] @ turn, between[:3, 3]) @ invert(T_BASE_CAMERA)
        if tf:
            messages.append(("/tf", transforms(transform(stamp, "odom", "base_link", T_odom_base))))
        else:
            messages.append(("/odom", odometry(stamp, T_odom_base, "odom", "base_link")))
    return write_messages(path, messages)


@pytest.mark.parametrize("tf", [False, True])
def test_a_bag_says_where_the_camera_was(tf, tmp_path, capsys):
    truth = random_similarity(np.random.default_rng(2))
    pairs = as_pairs(curve(8), truth, Errors(), np.random.default_rng(0))
    answers = write_tum(tmp_path / "answers.tum", pairs.answers)
    bag = robot_bag(tmp_path / "bag", pairs.references, [], tf)
    arguments = ["trajectory", "--answers", str(answers), "--bag", str(bag), "--out", str(tmp_path / "map.yaml")]
    arguments += ["--frame", "odom"] if tf else ["--odom", "/odom"]
    assert main([*arguments, "--camera-frame", CAMERA_FRAME]) == 0
    scale, degrees = far(placed_by(tmp_path / "map.yaml"), truth)
    assert scale < 1e-6
    assert degrees < 1e-4
    assert main(arguments) == 2
    assert "what is the camera's frame" in capsys.readouterr().err
    assert main([*arguments, "--camera-frame", "elsewhere"]) == 2
    said = capsys.readouterr().err
    assert ("tf to odom" if tf else "--extrinsics") in said


def test_a_file_may_have_the_trajectory_of_the_base_whose_camera_the_bag_tells(tmp_path, capsys):
    truth = random_similarity(np.random.default_rng(3))
    pairs = as_pairs(curve(8), truth, Errors(), np.random.default_rng(0))
    answers = write_tum(tmp_path / "answers.tum", pairs.answers)
    of_base = write_tum(tmp_path / "base.tum", pairs.references @ invert(T_BASE_CAMERA))
    bag = robot_bag(tmp_path / "bag", pairs.references[:1], [], False)
    arguments = ["trajectory", "--answers", str(answers), "--trajectory", str(of_base), "--body", "base_link"]
    arguments += ["--out", str(tmp_path / "map.yaml")]
    mounted = ["--bag", str(bag), "--camera-frame", CAMERA_FRAME]
    assert main([*arguments, *mounted]) == 0
    scale, degrees = far(placed_by(tmp_path / "map.yaml"), truth)
    assert scale < 1e-6
    assert degrees < 1e-4
    assert main(arguments) == 2
    assert "--body: name the bag" in capsys.readouterr().err
    assert main([*arguments, *mounted, "--body", "elsewhere"]) == 2
    assert "elsewhere" in capsys.readouterr().err


@pytest.mark.slow
def test_a_drive_is_localized_and_aligned(room_camera, room_photos, room_map_file, tmp_path, capsys):
    """Map and answers are in a frame of their own; the robot's is the room's."""
    now = random_similarity(np.random.default_rng(4))
    # So that the defaults of priors, in map units, suit.
    now = replace(now, scale=1.3)
    images, photos = [], room_photos[:6]
    for number, photo in enumerate(photos):
        stamp = 100.0 + number
        images += [
            (TOPICS["prior"], pose_stamped(stamp, now.transform_pose(photo.T_map_camera))),
            (TOPICS["camera_info"], camera_info(stamp, room_camera)),
            (TOPICS["image"], image(stamp, photo.image)),
        ]
    bag = robot_bag(tmp_path / "bag", np.array([photo.T_map_camera for photo in photos]), images, tf=False)
    arguments = ["drive", str(bag), "--map", str(room_map_file), "--image", TOPICS["image"], "--odom", "/odom"]
    arguments += ["--camera-info", TOPICS["camera_info"], "--prior", TOPICS["prior"], "--out", str(tmp_path / "y.yaml")]
    assert main([*arguments, *options_of(now)]) == 0
    assert "localized 6 of 6 photos" in capsys.readouterr().out
    found = placed_by(tmp_path / "y.yaml")
    scale, degrees = far(found, Similarity())
    assert scale < 0.01
    assert degrees < 0.3
    assert np.linalg.norm(found.translation) < 0.03


def test_a_trajectory_is_read_to_the_nanosecond(tmp_path):
    (tmp_path / "t.tum").write_text("1700000000.123456789, 1 2 3 0 0 0 2 # a comment\n")
    ((stamp, pose),) = read_tum(tmp_path / "t.tum")
    assert stamp == 1_700_000_000_123_456_789
    assert pose[:3, 3].tolist() == [1, 2, 3]
