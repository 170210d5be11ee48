"""Replay of bags, its outputs read back with code of their own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from bags import (
    TOPICS,
    TRUTH,
    camera_info,
    compressed_image,
    image,
    odometry,
    pose_stamped,
    pose_with_covariance,
    recording,
    replay_arguments,
    rotated,
    rows_of,
    write_messages,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin

from gsfeatloc_ros.common.geometry import make_pose, so3_exp
from gsfeatloc_ros.localize.engine import Engine
from gsfeatloc_ros.localize.localizer import Localizer
from gsfeatloc_ros.localize.options import LocalizerOptions
from gsfeatloc_ros.maps import load_map
from gsfeatloc_ros.match import create_matcher
from gsfeatloc_ros.render import create_renderer
from gsfeatloc_ros.replay.bag import Role, open_bag
from gsfeatloc_ros.replay.run import Replay
from gsfeatloc_ros.replay.truth import MAX_GAP, Trajectory
from gsfeatloc_ros.ros_io.decode import decode_covariance
from gsfeatloc_ros.ros_io.outcome import OutcomeStatus
from gsfeatloc_ros.ros_io.settings import Settings
from gsfeatloc_ros.simulate import write_bag
from gsfeatloc_ros.tools.replay import NOTHING_LOCALIZED, main

storages = pytest.mark.parametrize(
    "storage",
    [
        pytest.param(StoragePlugin.MCAP, id="mcap"),
        pytest.param(StoragePlugin.SQLITE3, id="sqlite3", marks=pytest.mark.slow),
    ],
)
# A slow, shared machine is no reason to fail.
unhurried = settings(deadline=None, max_examples=25, suppress_health_check=list(HealthCheck))


def distance(pose: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Degrees, by the trace of the rotation between, and map units; of x y z qx qy qz qw and a matrix (4, 4)."""
    cosine = (np.trace(rotated(pose[3:]).T @ truth[:3, :3]) - 1) / 2
    return np.degrees(np.arccos(min(cosine, 1.0))), np.linalg.norm(pose[:3] - truth[:3, 3])


@storages
def test_outputs_of_a_bag(storage, room_camera, room_photos, room_map_file, tmp_path, capsys):
    photos, out = room_photos[:3], tmp_path / "new" / "out"
    write_bag(tmp_path / "bag", room_camera, photos, storage)
    assert main(replay_arguments(tmp_path / "bag", room_map_file, out)) == 0
    said = capsys.readouterr().out
    assert "localized 3 of 3 images" in said
    assert "truth known for 3 of the 3 answers" in said

    tum, rows = np.loadtxt(out / "answers.tum"), rows_of(out)
    assert tum.shape == (3, 8)
    assert [row["status"] for row in rows] == ["localized"] * 3
    for photo, line, row in zip(photos, tum, rows, strict=True):
        assert line[0] == float(row["stamp"]) == float(row["bag_time"]) == photo.stamp
        rotation, translation = distance(line[1:], photo.T_map_camera)
        assert rotation < 1
        assert translation < 0.02
        assert float(row["rotation_error_deg"]) == pytest.approx(rotation, abs=2e-3)
        assert float(row["translation_error"]) == pytest.approx(translation, abs=1e-6)
        assert float(row["prior_rotation_error_deg"]) > 9
        assert [float(row[name]) for name in ("x", "y", "z", "qx", "qy", "qz", "qw")] == pytest.approx(line[1:])
        assert int(row["inliers"]) >= 20
        assert float(row["ms"]) > 0

    metadata = yaml.safe_load((out / "answers" / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert metadata["storage_identifier"] == storage.name.lower()
    with AnyReader([out / "answers"]) as reader:
        assert {(c.topic, c.msgtype) for c in reader.connections} == {
            ("/pose", "geometry_msgs/msg/PoseWithCovarianceStamped")
        }
        answers = [(time, reader.deserialize(cdr, c.msgtype)) for c, time, cdr in reader.messages()]
    for photo, line, row, (time, message) in zip(photos, tum, rows, answers, strict=True):
        assert (message.header.stamp.sec, message.header.frame_id, time) == (photo.stamp, "map", 1e9 * photo.stamp)
        p, q = message.pose.pose.position, message.pose.pose.orientation
        assert [p.x, p.y, p.z, q.x, q.y, q.z, q.w] == pytest.approx(line[1:], abs=1e-8)
        variances = [float(row[f"var_{name}"]) for name in ("x", "y", "z", "rx", "ry", "rz")]
        assert message.pose.covariance.reshape(6, 6).diagonal() == pytest.approx(variances)
    picture = cv2.imread(str(out / "errors.png"))
    assert picture.std() > 10


@pytest.mark.slow
def test_answers_are_those_of_the_localizer(room_camera, room_photos, room_map_file, tmp_path):
    write_bag(tmp_path / "bag", room_camera, room_photos[:2])
    assert (
        main(replay_arguments(tmp_path / "bag", room_map_file, tmp_path / "out", "--set", "max_passes=2", truth=False))
        == 0
    )
    renderer, matcher = create_renderer(load_map(room_map_file)), create_matcher("sift")
    localizer = Localizer(renderer, matcher, LocalizerOptions(max_passes=2))
    for photo, line, row in zip(
        room_photos, np.loadtxt(tmp_path / "out" / "answers.tum"), rows_of(tmp_path / "out"), strict=False
    ):
        estimate = localizer.localize(photo.image, room_camera, photo.T_map_camera_prior)
        assert row["reason"] == estimate.reason
        assert line[1:4] == pytest.approx(estimate.T_map_camera[:3, 3], abs=1e-8)
        assert rotated(line[4:]) == pytest.approx(estimate.T_map_camera[:3, :3], abs=1e-7)
    assert "rotation_error_deg" not in rows_of(tmp_path / "out")[0]
    assert not (tmp_path / "out" / "errors.png").exists()


@pytest.mark.slow
def test_other_types_of_messages(room_camera, room_photos, room_map_file, tmp_path, capsys):
    photo = room_photos[0]
    step = make_pose(so3_exp(np.array([0.0, 0.0, 0.1])), [0.02, 0.0, 0.0])
    messages = [
        (TOPICS["prior"], pose_with_covariance(1.0, photo.T_map_camera_prior, np.diag([0.3] * 6))),
        (TOPICS["camera_info"], camera_info(1.0, room_camera)),
        (TOPICS["image"], compressed_image(100.0, photo.image, ".jpg", "rgb8; jpeg compressed bgr8")),
        (TOPICS["image"], compressed_image(101.0, photo.image, ".png", "png")),
        # The truth of the first image is half way between two; that of the second is not known.
        (TRUTH, odometry(100.1, photo.T_map_camera @ step)),
        (TRUTH, odometry(99.9, photo.T_map_camera @ np.linalg.inv(step))),
    ]
    # The prior is a hundred seconds older than the images.
    bag, limit = write_messages(tmp_path / "bag", messages), ("--prior-max-age", "0")
    assert main(replay_arguments(bag, room_map_file, tmp_path / "out", *limit)) == 0
    jpeg, png = rows_of(tmp_path / "out")
    assert (jpeg["status"], png["status"]) == ("localized", "localized")
    assert float(jpeg["rotation_error_deg"]) < 0.5
    assert float(jpeg["translation_error"]) < 0.02
    assert (png["rotation_error_deg"], png["translation_error"]) == ("", "")
    assert "truth known for 1 of the 2 answers" in capsys.readouterr().out


@pytest.mark.slow
def test_the_command_needs_no_ros(room_camera, room_photos, room_map_file, tmp_path):
    write_bag(tmp_path / "bag", room_camera, room_photos[:1])
    hide = "import sys; sys.modules.update(dict.fromkeys(['rclpy', 'sensor_msgs', 'geometry_msgs']));"
    code = f"{hide} from gsfeatloc_ros.tools.replay import NOTHING_LOCALIZED, main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, *replay_arguments(tmp_path / "bag", room_map_file, tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "localized 1 of 1 images" in done.stdout
    assert "1/1" in done.stderr  # the progress bar


SMALL = np.zeros((48, 64, 3), np.uint8)
EVENTS = ("image", "corrupt image", "odd image", "info", "bad info", "corrupt info", "prior", "bad prior")


def event_message(event: str, number: int, camera) -> tuple:
    stamp, pose = 5.0 + number, make_pose(np.eye(3), [number, 0, 0])
    messages = {
        "image": ("image", image(stamp, SMALL)),
        "corrupt image": ("image", ("sensor_msgs/msg/Image", b"\x00\x01\x00\x00\x05")),
        "odd image": ("image", image(stamp, SMALL, "rgb9")),
        "info": ("camera_info", camera_info(stamp, camera)),
        "bad info": ("camera_info", camera_info(stamp, camera, focal=-1.0)),
        "corrupt info": ("camera_info", ("sensor_msgs/msg/CameraInfo", b"")),
        "prior": ("prior", pose_stamped(stamp, pose)),
        "bad prior": ("prior", pose_stamped(stamp, pose * np.nan)),
    }
    role, message = messages[event]
    return TOPICS[role], message


@unhurried
@given(st.lists(st.sampled_from(EVENTS), max_size=9), st.sampled_from([StoragePlugin.MCAP, StoragePlugin.SQLITE3]))
def test_images_are_paired_with_the_newest(engine, small_camera, tmp_path_factory, events, storage):
    events = [*events, "image"]
    messages = [event_message(event, number, small_camera) for number, event in enumerate(events)]
    kinds = {
        TOPICS["image"]: "sensor_msgs/msg/Image",
        TOPICS["camera_info"]: "sensor_msgs/msg/CameraInfo",
        TOPICS["prior"]: "geometry_msgs/msg/PoseStamped",
    }
    bag = write_messages(tmp_path_factory.mktemp("bag") / "bag", messages, storage, kinds)
    with open_bag(bag, {Role(role): [topic] for role, topic in TOPICS.items()}) as opened:
        replay = Replay(opened, engine, Settings())
        replayed = iter(list(replay.images()))
    # A prior that cannot be used is worse than none: without one, the image may be anywhere.
    info, prior = None, "none"
    unusable = 0
    for number, event in enumerate(events):
        unusable += event in ("bad info", "corrupt info", "bad prior")
        if "info" in event:
            info = event == "info"
        elif "prior" in event:
            prior = number if event == "prior" else None
        else:
            image = next(replayed)
            assert image.stamp == (None if event == "corrupt image" else 10**9 * (5 + number))
            if event == "image" and info and prior is not None:
                assert image.outcome.status is OutcomeStatus.FAILED
                assert image.outcome.reason
                if prior == "none":
                    assert image.query.T_map_camera_prior is None
                else:
                    assert image.query.T_map_camera_prior[0, 3] == prior
            else:
                assert image.outcome.status is OutcomeStatus.REFUSED
                assert image.outcome.reason
            assert image.pose is None
    assert next(replayed, None) is None
    assert sum(replay.unusable.values()) == unusable


@pytest.fixture(scope="session")
def small_camera(room_camera):
    return room_camera.scaled(64, 48)


@pytest.fixture(scope="session")
def engine(room_map):
    return Engine("", create_renderer(room_map), create_matcher("sift"), LocalizerOptions())


def test_images_that_cannot_be_used_are_lines(room_camera, room_photos, room_map_file, tmp_path, capsys):
    photo = room_photos[0]
    messages = [
        (TOPICS["image"], image(1.0, photo.image)),
        *recording(photo, room_camera),
        (TOPICS["image"], image(2.0, SMALL)),
        (TOPICS["image"], ("sensor_msgs/msg/Image", b"\x00\x01\x00\x00\xff")),
        (TRUTH, ("geometry_msgs/msg/PoseStamped", b"\x00\x01\x00\x00\xff")),
    ]
    assert main(replay_arguments(write_messages(tmp_path / "bag", messages), room_map_file, tmp_path / "out")) == 0
    rows = rows_of(tmp_path / "out")
    assert [row["status"] for row in rows] == ["refused", "localized", "refused", "refused"]
    assert rows[0]["reason"] == "no camera_info was recorded before this image"
    assert rows[2]["reason"].startswith("camera_info is for 640x480 but the image is 64x48")
    assert rows[3]["reason"].startswith("the bytes of this message are no sensor_msgs/msg/Image")
    assert (rows[3]["stamp"], rows[3]["bag_time"]) == ("", "1.007000000")
    said = capsys.readouterr().out
    assert "localized 1 of 4 images" in said
    assert "3 refused:\n    1 x " in said
    assert "truth messages that cannot be used:\n    1 x the bytes" in said


@pytest.mark.slow
def test_an_exception_is_a_line_and_an_interruption_keeps_what_came_before(
    room_camera, room_photos, room_map_file, tmp_path, monkeypatch, capsys
):
    write_bag(tmp_path / "bag", room_camera, room_photos[:3])
    # The first is the one that compiles everything.
    raised = iter([None, MemoryError("no room"), None, KeyboardInterrupt()])
    localize = Localizer.localize

    def fail(*args: object) -> object:
        if error := next(raised):
            raise error
        return localize(*args)

    monkeypatch.setattr(Localizer, "localize", fail)
    assert main(replay_arguments(tmp_path / "bag", room_map_file, tmp_path / "out")) == 130
    said = capsys.readouterr()
    assert "replay: interrupted" in said.err
    assert "localized 1 of 2 images; the bag has 3" in said.out
    rows = rows_of(tmp_path / "out")
    assert [row["status"] for row in rows] == ["error", "localized"]
    assert rows[0]["reason"] == "MemoryError: no room"
    with AnyReader([tmp_path / "out" / "answers"]) as reader:
        assert len(list(reader.messages())) == 1


def test_no_answer_at_all(room_camera, room_map_file, tmp_path, capsys):
    bag = write_messages(
        tmp_path / "bag",
        [event_message("image", 0, room_camera)],
        topics={
            TOPICS["camera_info"]: "sensor_msgs/msg/CameraInfo",
            TOPICS["prior"]: "geometry_msgs/msg/PoseStamped",
            TRUTH: "geometry_msgs/msg/PoseStamped",
        },
    )
    assert main(replay_arguments(bag, room_map_file, tmp_path / "out")) == NOTHING_LOCALIZED
    said = capsys.readouterr()
    assert "localized NONE of 1 images" in said.out
    assert "replay: nothing was localized" in said.err
    assert (tmp_path / "out" / "answers.tum").read_text() == ""
    assert [row["status"] for row in rows_of(tmp_path / "out")] == ["refused"]
    assert (tmp_path / "out" / "errors.png").exists()


def refused(capsys, arguments: list[str]) -> str:
    """What the command says when it ends with 1: one line."""
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert said.startswith("replay: ")
    assert said.count("\n") == 1
    return said


@pytest.mark.parametrize(
    ("option", "topic", "says"),
    [
        ("--image", "/no", r"bag: has no topic /no; it has /camera/camera_info (sensor_msgs/msg/CameraInfo), /camera/"),
        ("--prior", "/camera/camera_info", "has sensor_msgs/msg/CameraInfo; prior must be geometry_msgs/msg/PoseStam"),
        ("--truth", "/camera/image_raw", "truth must be geometry_msgs/msg/PoseStamped or geometry_msgs/msg/PoseWith"),
        ("--map", "/no.ply", "/no.ply: cannot be read"),
        ("--map-rotation", "0 0 0 0", "has no direction"),
        ("--map-scale", "-1", "parameter map.scale: -1.0 is not within 1e-06 and 1e+06"),
        ("-p", "search.planar:=true", "search.planar needs map.aligned: set it to true once"),
        ("-p", "index.camera_height:=0.4", "index.camera_height needs map.aligned: set it to true once"),
    ],
)
def test_options_that_cannot_be_used(room_camera, room_photos, room_map_file, tmp_path, capsys, option, topic, says):
    write_bag(tmp_path / "bag", room_camera, room_photos[:1])
    options = replay_arguments(tmp_path / "bag", room_map_file, tmp_path / "out", option, *topic.split())
    assert says in refused(capsys, options)
    assert not (tmp_path / "out").exists()


@storages
def test_bags_that_cannot_be_used(storage, room_camera, room_photos, room_map_file, tmp_path, capsys):
    def says(bag: Path) -> str:
        return refused(capsys, replay_arguments(bag, room_map_file, tmp_path / "out", truth=False))

    assert "no: there is no such bag" in says(tmp_path / "no")
    (tmp_path / "folder").mkdir()
    assert "folder: is no rosbag2: this folder has no .mcap or .db3 file" in says(tmp_path / "folder")
    (tmp_path / "notes.txt").write_text("not a bag, but long enough to be none of the two")
    assert "notes.txt: is no file of a rosbag2: neither MCAP nor SQLite" in says(tmp_path / "notes.txt")
    (tmp_path / "old.bag").write_text("#ROSBAG V2.0\n")
    assert "old.bag: is a bag of ROS 1" in says(tmp_path / "old.bag")
    assert "has no topic /camera/image_raw; it has none: it is empty" in says(
        write_messages(tmp_path / "bare", [], storage)
    )
    quiet = dict.fromkeys(TOPICS.values(), "sensor_msgs/msg/Image") | {
        TOPICS["camera_info"]: "sensor_msgs/msg/CameraInfo",
        TOPICS["prior"]: "geometry_msgs/msg/PoseStamped",
    }
    assert "has no message on /camera/image_raw" in says(write_messages(tmp_path / "quiet", [], storage, quiet))

    write_bag(tmp_path / "bag", room_camera, room_photos[:2], storage)
    (file,) = (tmp_path / "bag").glob("bag.*")
    whole = file.read_bytes()
    for size in (0, 5, len(whole) // 2):
        file.write_bytes(whole[:size])
        assert f"{file.name}: was cut short while it was recorded or copied: try ros2 bag reindex" in says(file)
    # What is damaged otherwise was not cut short.
    file.write_bytes(whole[:16] + bytes(len(whole) - 24) + whole[-8:])
    assert "cut short" not in says(file)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_what_comes_before_a_damage_is_kept(room_camera, room_photos, room_map_file, tmp_path, capsys):
    write_bag(tmp_path / "bag", room_camera, room_photos[:4], StoragePlugin.SQLITE3)
    file = tmp_path / "bag" / "bag.db3"
    whole = file.read_bytes()
    middle = len(whole) // 2
    file.write_bytes(whole[:middle] + b"\xff" * 5000 + whole[middle + 5000 :])
    assert main(replay_arguments(tmp_path / "bag", room_map_file, tmp_path / "out")) == 2
    said = capsys.readouterr()
    assert "bag: is damaged, and ends here: " in said.err
    assert "; the bag has 4" in said.out
    rows = rows_of(tmp_path / "out")
    assert 0 < len(rows) < 4
    assert {row["status"] for row in rows} == {"localized"}
    assert len(np.loadtxt(tmp_path / "out" / "answers.tum", ndmin=2)) == len(rows)


def test_the_folder_of_the_results_must_be_empty(room_camera, room_photos, room_map_file, tmp_path, capsys):
    write_bag(tmp_path / "bag", room_camera, room_photos[:1])
    said = refused(capsys, replay_arguments(tmp_path / "bag", room_map_file, tmp_path))
    assert "is there already: name a new or an empty folder" in said


@pytest.mark.parametrize("text", ["max_views", "no_such=1", "max_views=many", "max_views=1,2"])
def test_settings_that_cannot_be_used(tmp_path, text, capsys):
    with pytest.raises(SystemExit) as stop:
        main(replay_arguments(tmp_path, tmp_path, tmp_path, "--set", text))
    assert stop.value.code == 2
    assert "argument --set" in capsys.readouterr().err


@unhurried
@given(st.integers(0, 2**60), st.floats(0, 1), st.floats(-3, 3), st.integers(1, round(1e9 * MAX_GAP)))
def test_truth_turns_and_moves_evenly_between_two_poses(start, share, angle, gap):
    axis = np.array([0.6, 0.0, 0.8])
    first = make_pose(so3_exp(np.array([0.3, -0.2, 0.9])), [1.0, 2.0, 3.0])
    last = first @ make_pose(so3_exp(angle * axis), [0.5, 0.0, -1.0])
    stamp = start + round(share * gap)
    between = Trajectory([(start + gap, last), (start, first)]).at(stamp)
    exact = (stamp - start) / gap
    assert between[:3, :3] == pytest.approx(first[:3, :3] @ so3_exp(exact * angle * axis), abs=1e-9)
    assert between[:3, 3] == pytest.approx((1 - exact) * first[:3, 3] + exact * last[:3, 3], abs=1e-9)


def test_truth_that_is_not_known():
    assert Trajectory([]).at(0) is None
    assert Trajectory([]).poses.shape == (0, 4, 4)
    one = Trajectory([(5, np.eye(4))])
    assert one.at(4) is None
    assert one.at(6) is None
    assert one.at(5) is not None
    gap = round(1e9 * MAX_GAP) + 1
    apart = Trajectory([(0, np.eye(4)), (gap, np.eye(4))])
    assert apart.at(1) is None
    assert apart.at(gap) is not None


def test_covariance_of_a_prior():
    covariance = np.diag([1.0, 2, 3, 0.1, 0.2, 0.3])
    covariance[0, 5] = covariance[5, 0] = 0.05
    assert np.array_equal(decode_covariance(pose_with_covariance(0, np.eye(4), covariance), "prior"), covariance)
    assert decode_covariance(pose_with_covariance(0, np.eye(4), np.zeros((6, 6))), "prior") is None
    assert decode_covariance(pose_stamped(0, np.eye(4)), "prior") is None
    for unknown in (np.nan, -1.0):
        message = pose_with_covariance(0, np.eye(4), np.diag([unknown, 1, 1, 1, 1, 1.0]))
        assert decode_covariance(message, "prior") is None
    for wrong in (np.inf, -2.0):
        with pytest.raises(ValueError, match="finite, and no variance negative"):
            decode_covariance(pose_with_covariance(0, np.eye(4), np.diag([wrong, 1, 1, 1, 1, 1.0])), "prior")
