"""Replay gives the localizer what the node gives it: tf, odometry, priors in any frame, calibrations; when due."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bags import (
    TOPICS,
    camera_info,
    image,
    odometry,
    pose_stamped,
    pose_with_covariance,
    transform,
    transforms,
    write_messages,
)

from gsfeatloc_ros.common.geometry import make_pose, so3_exp
from gsfeatloc_ros.localize.estimate import Estimate, Status
from gsfeatloc_ros.localize.options import LocalizerOptions
from gsfeatloc_ros.replay.bag import Role, open_bag
from gsfeatloc_ros.replay.run import Replay
from gsfeatloc_ros.ros_io.calibration_file import read_calibration
from gsfeatloc_ros.ros_io.outcome import OutcomeStatus
from gsfeatloc_ros.ros_io.settings import Settings
from gsfeatloc_ros.ros_io.state import State
from gsfeatloc_ros.simulate.bag_messages import CAMERA_FRAME

ODOM, INITIAL_POSE, TF, TF_STATIC = "/odom", "/initialpose", "/tf", "/tf_static"
ROLES = {Role(role): [topic] for role, topic in TOPICS.items()}
ALL_ROLES = ROLES | {Role.TF: [TF], Role.TF_STATIC: [TF_STATIC]}
TYPES = {
    TOPICS["image"]: "sensor_msgs/msg/Image",
    TOPICS["camera_info"]: "sensor_msgs/msg/CameraInfo",
    TOPICS["prior"]: "geometry_msgs/msg/PoseStamped",
}
SMALL = np.zeros((48, 64, 3), np.uint8)
T_BASE_CAMERA = make_pose(so3_exp(np.array([0.3, 0.0, 0.5])), [0.1, 0.2, 0.9])
T_MAP_ODOM = make_pose(so3_exp(np.array([0.0, 0.0, 0.7])), [2.0, -1.0, 0.0])
POSE = make_pose(so3_exp(np.array([0.1, 0.2, 0.3])), [1.0, 2.0, 3.0])
MOUNTED = (TF_STATIC, transforms(transform(1.0, "base_link", CAMERA_FRAME, T_BASE_CAMERA)))


class Recorder:
    """An engine that finds the camera where it is told, one image after the other, and remembers what it was given."""

    options = LocalizerOptions()

    def __init__(self, *answers: np.ndarray | None) -> None:
        self._answers = iter(answers)
        self.cameras: list = []
        self.priors: list = []
        self.covariances: list = []
        self.seeds: list[int] = []
        self.localizer = self

    def with_options(self, options: LocalizerOptions) -> Recorder:
        self.seeds.append(options.seed)
        return self

    def localize(self, image, camera, prior, covariance) -> Estimate:
        self.cameras.append(camera)
        self.priors.append(prior)
        self.covariances.append(covariance)
        answer = next(self._answers, None)
        if answer is None:
            return Estimate(Status.FAILED, "nothing in common")
        return Estimate(Status.LOCALIZED, "found", answer, np.eye(6) * 1e-4)


@pytest.fixture(scope="session")
def small_camera(room_camera):
    return room_camera.scaled(64, 48)


@pytest.fixture
def info(small_camera):
    return TOPICS["camera_info"], camera_info(1.0, small_camera)


def replayed(tmp_path, messages, engine, roles=ALL_ROLES, calibration=None, step=0.001, **parameters):
    bag = write_messages(tmp_path / "bag", messages, topics=TYPES, step=step)
    values = {name.replace("__", "."): value for name, value in parameters.items()}
    with open_bag(bag, roles) as opened:
        replay = Replay(opened, engine, Settings.checked(values), calibration)
        return list(replay.images()), replay


def test_a_prior_of_the_base_in_another_frame(tmp_path, info):
    engine = Recorder()
    messages = [
        MOUNTED,
        (TF, transforms(transform(9.0, "map", "odom", T_MAP_ODOM), transform(11.0, "map", "odom", T_MAP_ODOM))),
        info,
        (TOPICS["prior"], pose_stamped(10.0, POSE, "odom")),
        (TOPICS["image"], image(10.0, SMALL)),
    ]
    replayed(tmp_path, messages, engine, prior_frame="base")
    np.testing.assert_allclose(engine.priors[0], T_MAP_ODOM @ POSE @ T_BASE_CAMERA, atol=1e-9)


def test_the_initial_pose_is_of_the_base(tmp_path, info):
    engine = Recorder()
    pose = (INITIAL_POSE, pose_with_covariance(10.0, POSE, np.eye(6)))
    roles = ALL_ROLES | {Role.INITIAL_POSE: [INITIAL_POSE]}
    replayed(tmp_path, [MOUNTED, info, pose, (TOPICS["image"], image(10.0, SMALL))], engine, roles)
    np.testing.assert_allclose(engine.priors[0], POSE @ T_BASE_CAMERA, atol=1e-9)


@pytest.mark.parametrize(("delay", "waited"), [(0.4, True), (0.6, False)])
def test_tf_is_waited_for_as_by_the_node(tmp_path, info, delay, waited):
    engine = Recorder()
    messages = [
        info,
        (TOPICS["prior"], pose_stamped(10.0, POSE)),
        (TOPICS["image"], image(10.0, SMALL)),
        MOUNTED,
        (TOPICS["image"], image(11.0, SMALL)),
    ]
    images, _ = replayed(tmp_path, messages, engine, step=delay, prior_frame="base")
    assert [each.outcome.status for each in images] == [
        OutcomeStatus.FAILED if waited else OutcomeStatus.REFUSED,
        OutcomeStatus.FAILED,
    ]
    assert waited or "tf has no transform from 'camera' to 'base_link'" in images[0].outcome.reason


def test_answers_of_the_base(tmp_path, info):
    images, _ = replayed(
        tmp_path, [MOUNTED, info, (TOPICS["image"], image(10.0, SMALL))], Recorder(POSE), pose_frame="base"
    )
    np.testing.assert_allclose(images[0].pose.T_map_body @ T_BASE_CAMERA, POSE, atol=1e-9)
    np.testing.assert_allclose(images[0].T_map_camera, POSE, atol=1e-9)


def test_one_prior_carried_by_odometry_and_then_answers(tmp_path, info):
    """The prior is of the first image; odometry of the base says where the second and the third were."""
    step = make_pose(so3_exp(np.array([0.0, 0.0, 0.2])), [0.5, 0.0, 0.0])
    moved = np.linalg.inv(T_BASE_CAMERA) @ step @ T_BASE_CAMERA
    way = [np.eye(4), step, step @ step]
    messages = [MOUNTED, info, (TOPICS["prior"], pose_stamped(10.0, POSE))]
    for number, pose in enumerate(way):
        messages += [
            (ODOM, odometry(10.0 + number, pose, "odom", "base_link")),
            (TOPICS["image"], image(10.0 + number, SMALL)),
        ]
    off = make_pose(np.eye(3), [0.1, 0, 0])
    engine = Recorder(None, POSE @ moved @ off)
    roles = ALL_ROLES | {Role.ODOMETRY: [ODOM]}
    images, _ = replayed(tmp_path, messages, engine, roles, track=True)
    np.testing.assert_allclose(engine.priors[0], POSE, atol=1e-9)
    np.testing.assert_allclose(engine.priors[1], POSE @ moved, atol=1e-9)
    np.testing.assert_allclose(engine.priors[2], POSE @ moved @ off @ moved, atol=1e-9)
    assert [each.query.source.value for each in images] == ["prior", "prior", "last answer"]
    # What was searched in vain is searched with another seed.
    assert engine.seeds == [0, 1, 0]


def test_what_was_found_without_a_prior_has_to_be_confirmed(tmp_path, info):
    messages = [info]
    for number in range(2):
        messages += [
            (ODOM, odometry(10.0 + number, np.eye(4), "odom", CAMERA_FRAME)),
            (TOPICS["image"], image(10.0 + number, SMALL)),
        ]
    images, _ = replayed(tmp_path, messages, Recorder(POSE, POSE), ALL_ROLES | {Role.ODOMETRY: [ODOM]}, track=True)
    assert [each.outcome.status for each in images] == [OutcomeStatus.UNCONFIRMED, OutcomeStatus.LOCALIZED]
    assert [each.state for each in images] == [State.LOST, State.LOCALIZED]
    assert images[0].pose is None


def test_the_state_follows_the_time_of_the_recording(tmp_path, info):
    messages = [info] + [(TOPICS["image"], image(10.0 + 4 * number, SMALL)) for number in range(6)]
    images, _ = replayed(tmp_path, messages, Recorder(POSE), step=4.0)
    assert [each.state.value for each in images] == ["localized", *["coasting"] * 3, *["lost"] * 2]


def test_mode_and_rate(tmp_path, info):
    prior, images = (
        (TOPICS["prior"], pose_stamped(10.0, POSE)),
        [(TOPICS["image"], image(10.0 + 0.1 * number, SMALL)) for number in range(4)],
    )
    tried, replay = replayed(tmp_path, [info, prior, *images[:2], prior, *images[2:]], Recorder(), mode="on_prior")
    assert [each.stamp for each in tried] == [10_000_000_000, 10_200_000_000]
    assert replay.not_due == 2
    tried, replay = replayed(tmp_path / "rate", [info, *images], Recorder(), max_rate=5)
    assert [each.stamp for each in tried] == [10_000_000_000, 10_200_000_000]
    with pytest.raises(ValueError, match="mode is on_request, and in a recording nobody asks"):
        replayed(tmp_path / "request", [info, *images], Recorder(), mode="on_request")


def test_a_rolling_shutter_is_moved_by_odometry(tmp_path, info):
    messages = [info]
    for number, stamp in enumerate((9.9, 10.1)):
        messages.append((ODOM, odometry(stamp, make_pose(np.eye(3), [number, 0, 0]), "odom", CAMERA_FRAME)))
    engine = Recorder()
    messages.append((TOPICS["image"], image(10.0, SMALL)))
    roles = ALL_ROLES | {Role.ODOMETRY: [ODOM]}
    replayed(tmp_path, messages, engine, roles, track=True, image__line_delay=0.0001)
    np.testing.assert_allclose(engine.cameras[0].readout, [5 * 48 * 0.0001, 0, 0, 0, 0, 0], atol=1e-9)


def test_images_without_a_stamp_have_that_of_the_recording(tmp_path, info):
    images, replay = replayed(tmp_path, [info, (TOPICS["image"], image(0.0, SMALL))], Recorder(POSE))
    assert images[0].stamp == images[0].pose.stamp == images[0].bag_time == 1_002_000_000
    assert replay.unstamped == 1


CALIBRATION = """
image_width: 64
image_height: 48
camera_name: front
camera_matrix: {rows: 3, cols: 3, data: [50, 0, 32, 0, 51, 23, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.1, 0.01, 0, 0, 0]}
projection_matrix: {rows: 3, cols: 4, data: [40, 0, 31, 0, 0, 41, 22, 0, 0, 0, 1, 0]}
"""


@pytest.mark.parametrize(("rectified", "focal"), [(False, 50), (True, 40)])
def test_a_calibration_in_a_file(tmp_path, rectified, focal):
    (tmp_path / "camera.yaml").write_text(CALIBRATION)
    engine = Recorder()
    calibration = read_calibration(tmp_path / "camera.yaml")
    roles = {Role.IMAGE: [TOPICS["image"]]}
    messages = [(TOPICS["image"], image(10.0, SMALL))]
    replayed(tmp_path, messages, engine, roles, calibration, image__rectified=rectified)
    assert engine.cameras[0].K[0, 0] == focal
    assert engine.cameras[0].distorted != rectified


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "is no calibration .* no mapping"),
        ("[", "is no calibration"),
        (CALIBRATION.replace("image_width", "width"), "lacks the key 'image_width'"),
        (CALIBRATION.replace("50, 0,", "50,"), ".* camera_matrix has 8 numbers, not 9"),
        (CALIBRATION.replace("64", "many"), "is no calibration"),
        (CALIBRATION.replace("64", "-64"), ".* camera size -64x48 must be positive"),
        (CALIBRATION.replace("plumb_bob", "mei"), ".* distortion model 'mei' is not one of"),
    ],
)
def test_calibrations_that_cannot_be_used(tmp_path, text, says):
    (tmp_path / "camera.yaml").write_text(text)
    with pytest.raises(ValueError, match=f"camera.yaml: {says}"):
        read_calibration(tmp_path / "camera.yaml")


def test_a_calibration_that_no_camera_has(tmp_path):
    (tmp_path / "camera.yaml").write_text(CALIBRATION)
    calibration = replace(read_calibration(tmp_path / "camera.yaml"), k=[0.0] * 9)
    with pytest.raises(ValueError, match="K of zeros"):
        replayed(tmp_path, [(TOPICS["image"], image(1.0, SMALL))], Recorder(), calibration=calibration)
