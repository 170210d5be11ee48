"""What an image is localized with: one policy on priors, for the node and for replay."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ros_messages import SECOND, camera_info, image, odometry, prior

from gsfeatloc_ros.common.geometry import interpolate, invert, make_pose, so3_exp, so3_log
from gsfeatloc_ros.ros_io.growth import position_sigma
from gsfeatloc_ros.ros_io.inputs import Inputs, InputTopic
from gsfeatloc_ros.ros_io.prior import Prior, PriorPolicy, PriorSource, decode_prior

# The base looks along x, with z up; the camera is in front, higher, and looks ahead with z.
T_BASE_CAMERA = make_pose(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), [0.3, 0.0, 0.8])
T_MAP_ODOM = make_pose(so3_exp(np.array([0, 0, 0.7])), [5.0, -2.0, 0.1])

components = st.tuples(*[st.floats(-3, 3)] * 3).map(np.array)
poses = st.builds(lambda rotation, translation: make_pose(so3_exp(rotation), translation), components, components)
roots = st.lists(st.floats(-1, 1), min_size=36, max_size=36).map(lambda v: np.reshape(v, (6, 6)))


def lookup(target: str, source: str, at: int) -> np.ndarray:
    """A robot whose base moves along x of odom at 1 m/s."""
    T_odom_base = make_pose(np.eye(3), [1e-9 * at, 0.0, 0.0])
    known = {
        ("map", "odom"): T_MAP_ODOM,
        ("odom", "base_link"): T_odom_base,
        ("map", "base_link"): T_MAP_ODOM @ T_odom_base,
        ("base_link", "camera"): T_BASE_CAMERA,
    }
    if (target, source) not in known:
        raise ValueError(f"no way from {source} to {target}")
    return known[target, source]


def inputs(**policy: object) -> Inputs:
    made = Inputs(PriorPolicy(**policy), lookup, False, "no camera_info yet")
    made.take(InputTopic.CAMERA_INFO, camera_info())
    return made


def asked(made: Inputs, seconds: float, frame: str = "camera") -> np.ndarray:
    return made.for_image(image(seconds, frame)).T_map_camera_prior


def test_nothing_has_come():
    empty = Inputs(PriorPolicy(), lookup, False, "no camera_info yet")
    assert empty.missing == ["no camera_info yet"]
    with pytest.raises(ValueError, match="no camera_info yet"):
        empty.for_image(image(1))
    empty.take(InputTopic.CAMERA_INFO, camera_info())
    assert empty.missing == []
    anywhere = empty.for_image(image(1))
    assert (anywhere.T_map_camera_prior, anywhere.prior_covariance, anywhere.source) == (None, None, None)


@given(pose=poses)
def test_a_prior_of_the_camera_in_the_map_frame_is_taken_as_it_is(pose):
    made = inputs()
    made.take(InputTopic.PRIOR, prior(1, pose))
    taken = made.for_image(image(1, frame=""))
    np.testing.assert_allclose(taken.T_map_camera_prior, pose, atol=1e-9)
    assert taken.prior_covariance is None
    assert taken.image.shape == (6, 8, 3)


@given(pose=poses)
def test_a_prior_of_the_base_in_another_frame_goes_by_tf(pose):
    made = inputs(of_base=True)
    made.take(InputTopic.PRIOR, prior(1, pose, "odom"))
    np.testing.assert_allclose(asked(made, 1), T_MAP_ODOM @ pose @ T_BASE_CAMERA, atol=1e-9)


def test_a_prior_in_a_moving_frame_is_of_its_own_time():
    made = inputs()
    made.take(InputTopic.PRIOR, prior(3, np.eye(4), "base_link"))
    np.testing.assert_allclose(asked(made, 4), lookup("map", "base_link", 3 * SECOND), atol=1e-9)


def test_initialpose_is_of_the_base_whatever_priors_are_of():
    made = inputs(of_base=False)
    made.take(InputTopic.INITIAL_POSE, prior(1, np.eye(4)))
    np.testing.assert_allclose(asked(made, 1), T_BASE_CAMERA, atol=1e-12)


@given(pose=poses, root=roots)
def test_the_covariance_goes_with_the_pose(pose, root):
    """Against moving the base by small steps of which the covariance is made, and seeing where the camera goes."""
    made = inputs(of_base=True)
    made.take(InputTopic.PRIOR, prior(1, pose, "odom", 1e-8 * root @ root.T + 1e-12 * np.eye(6)))
    taken = made.for_image(image(1))
    camera, columns = taken.T_map_camera_prior, []
    for step in (1e-4 * root).T:
        moved = make_pose(so3_exp(step[3:]) @ pose[:3, :3], pose[:3, 3] + step[:3])
        there = T_MAP_ODOM @ moved @ T_BASE_CAMERA
        rotation = so3_log(there[:3, :3] @ camera[:3, :3].T)
        columns.append(np.concatenate([there[:3, 3] - camera[:3, 3], rotation]))
    expected = np.array(columns).T @ np.array(columns)
    np.testing.assert_allclose(taken.prior_covariance, expected, atol=2e-3 * max(np.abs(expected).max(), 1e-8))


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"frame": "mars"}, "prior is in frame 'mars' but the map is in 'map': no way from mars to map"),
        ({"frame": ""}, "prior is in frame ''"),
        ({"pose": make_pose(np.eye(3), [np.nan, 0, 0])}, "must be finite"),
        ({"covariance": -2 * np.eye(6)}, "no variance negative"),
    ],
)
def test_a_prior_that_cannot_be_used(changes, says):
    made = inputs()
    arguments = {"seconds": 1, "pose": np.eye(4)} | changes

    def take_and_ask():
        made.take(InputTopic.PRIOR, prior(**arguments))
        made.for_image(image(1))

    with pytest.raises(ValueError, match=says):
        take_and_ask()


BAD_POSE = make_pose(np.eye(3), [np.nan, 0, 0])


@pytest.mark.parametrize("topic", [InputTopic.PRIOR, InputTopic.INITIAL_POSE])
def test_a_prior_that_cannot_be_used_takes_the_place_of_a_good_one(topic):
    made = inputs()
    made.take(InputTopic.PRIOR, prior(1, np.eye(4)))
    with pytest.raises(ValueError, match=f"^{topic.value} has position .* must be finite") as error:
        made.take(topic, prior(2, BAD_POSE))
    assert made.missing == [str(error.value)]
    with pytest.raises(ValueError, match="must be finite"):
        made.for_image(image(1))


def test_a_camera_info_that_cannot_be_used_takes_the_place_of_a_good_one():
    made = inputs()
    made.take(InputTopic.PRIOR, prior(1, np.eye(4)))
    with pytest.raises(ValueError, match="its size is 0x6"):
        made.take(InputTopic.CAMERA_INFO, camera_info(width=0))
    with pytest.raises(ValueError, match="its size is 0x6"):
        made.for_image(image(1))


def test_odometry_that_cannot_be_used_leaves_the_older_in_its_place():
    made = inputs(of_base=True)
    made.take(InputTopic.PRIOR, prior(100, T_MAP_ODOM))
    drive(made, 99, 105)
    with pytest.raises(ValueError, match=r"^odom has position .* must be finite"):
        made.take(InputTopic.ODOMETRY, odometry(105.05, BAD_POSE))
    ahead = make_pose(np.eye(3), [5, 0, 0])
    np.testing.assert_allclose(asked(made, 105), T_MAP_ODOM @ ahead @ T_BASE_CAMERA, atol=1e-9)


def test_what_is_invalidated_says_why():
    made = inputs()
    made.take(InputTopic.PRIOR, prior(1, np.eye(4)))
    for topic in InputTopic:
        made.invalidate(topic, f"a bad {topic.value}")
    assert made.missing == ["a bad camera_info", "a bad initialpose"]


def test_an_image_of_another_size_than_the_camera():
    made = inputs()
    made.take(InputTopic.CAMERA_INFO, camera_info(width=16))
    made.take(InputTopic.PRIOR, prior(1, np.eye(4)))
    with pytest.raises(ValueError, match="camera_info is for 16x6 but the image is 8x6"):
        made.for_image(image(1))


def test_a_prior_of_the_future_is_refused():
    made = inputs()
    made.take(InputTopic.PRIOR, prior(100, np.eye(4)))
    with pytest.raises(ValueError, match=r"prior is 10\.5 s newer than the image .*prior_max_age.*: do the clocks"):
        made.for_image(image(89.5))
    np.testing.assert_array_equal(asked(made, 90.1), np.eye(4))


@given(seconds=st.floats(0.0, 1000.0))
def test_an_old_prior_means_a_wider_search(seconds):
    made = inputs()
    made.take(InputTopic.PRIOR, prior(100, np.eye(4)))
    taken = made.for_image(image(100 + seconds))
    np.testing.assert_array_equal(taken.T_map_camera_prior, np.eye(4))
    if seconds < 9.999:
        assert taken.prior_covariance is None
    if seconds > 10.001:
        expected = made.policy.growth.by_time(seconds).added_to(made.policy.default_covariance(), False)
        np.testing.assert_allclose(taken.prior_covariance, expected, rtol=1e-6)


@pytest.mark.parametrize(("prior_seconds", "image_seconds"), [(0, 1e6), (100, 0)])
def test_without_a_stamp_there_is_no_age(prior_seconds, image_seconds):
    made = inputs()
    made.take(InputTopic.PRIOR, prior(prior_seconds, np.eye(4)))
    np.testing.assert_array_equal(asked(made, image_seconds), np.eye(4))


def test_no_limit_on_the_age():
    made = inputs(max_age=0.0)
    made.take(InputTopic.PRIOR, prior(100, np.eye(4)))
    taken = made.for_image(image(1e6))
    np.testing.assert_array_equal(taken.T_map_camera_prior, np.eye(4))
    assert taken.prior_covariance is None


def drive(made: Inputs, start: float, end: float, child: str = "base_link") -> None:
    """Odometry of a robot that moves along x of its own at 1 m/s, and does not turn."""
    for seconds in np.arange(start, end + 0.01, 0.05):
        made.take(InputTopic.ODOMETRY, odometry(seconds, make_pose(np.eye(3), [seconds, 0, 0]), child))


def test_odometry_carries_a_prior_to_the_image():
    made = inputs(of_base=True)
    made.take(InputTopic.PRIOR, prior(100, T_MAP_ODOM))
    drive(made, 99, 120)
    ahead = make_pose(np.eye(3), [17.5, 0, 0])
    np.testing.assert_allclose(asked(made, 117.5), T_MAP_ODOM @ ahead @ T_BASE_CAMERA, atol=1e-9)


def test_odometry_of_the_camera_itself():
    made = inputs()
    made.take(InputTopic.PRIOR, prior(100, T_MAP_ODOM))
    for seconds in np.arange(99, 110, 0.05):
        pose = make_pose(np.eye(3), [0, 0, seconds])
        made.take(InputTopic.ODOMETRY, odometry(seconds, pose, "camera_of_no_tf"))
    with pytest.raises(ValueError, match="no way from camera to camera_of_no_tf"):
        made.for_image(image(104))

    same = Inputs(PriorPolicy(), lambda target, source, at: np.eye(4), False, "")
    same.take(InputTopic.CAMERA_INFO, camera_info())
    same.take(InputTopic.PRIOR, prior(100, T_MAP_ODOM))
    for seconds in np.arange(99, 110, 0.05):
        same.take(InputTopic.ODOMETRY, odometry(seconds, make_pose(np.eye(3), [0, 0, seconds]), "camera"))
    np.testing.assert_allclose(asked(same, 104), T_MAP_ODOM @ make_pose(np.eye(3), [0, 0, 4]), atol=1e-9)


def test_odometry_carries_no_farther_than_allowed():
    made = inputs(odometry_max_age=15.0)
    made.take(InputTopic.PRIOR, prior(100, np.eye(4)))
    drive(made, 99, 118)
    # Ahead is along z of the camera.
    assert asked(made, 114.9)[2, 3] == pytest.approx(14.9)
    np.testing.assert_array_equal(asked(made, 115.1), np.eye(4))
    assert position_sigma(made.for_image(image(115.1)).prior_covariance) > 15.0


def test_the_way_that_odometry_measured_is_uncertain_in_part():
    made = inputs(of_base=True)
    made.take(InputTopic.PRIOR, prior(100, T_MAP_ODOM))
    drive(made, 99, 120)
    covariance = made.for_image(image(117.5)).prior_covariance
    share = made.policy.growth.odometry_distance_error
    assert position_sigma(covariance) == pytest.approx(np.hypot(0.5, share * 17.5), rel=0.01)


def test_another_body_s_odometry_is_another_odometry():
    made = inputs()
    made.take(InputTopic.PRIOR, prior(100, np.eye(4)))
    drive(made, 99, 105)
    drive(made, 103, 106, child="wheel")
    # Nothing is known of the wheel at 100 s.
    np.testing.assert_array_equal(asked(made, 105), np.eye(4))


def test_rows_of_a_rolling_shutter_are_read_while_the_camera_moves():
    made = inputs()
    made.take(InputTopic.PRIOR, prior(100, np.eye(4)))
    for step in range(21):  # it turns to the left by 0.5 rad/s
        turned = make_pose(so3_exp(np.array([0, 0, 0.025 * step])), np.zeros(3))
        made.take(InputTopic.ODOMETRY, odometry(99.5 + 0.05 * step, turned))
    assert made.for_image(image(100)).camera.readout is None
    made.line_delay = 0.001
    # Six rows. Left is the camera's -x, and up its -y; it is carried along, 0.3 m ahead of the base.
    np.testing.assert_allclose(
        made.for_image(image(100)).camera.readout, 0.006 * np.array([-0.15, 0, 0, 0, -0.5, 0]), atol=1e-9
    )
    # Where nobody knows how it moves it is taken to stand still.
    made.take(InputTopic.PRIOR, prior(105, np.eye(4)))
    assert made.for_image(image(105)).camera.readout is None


def answer(seconds: float, pose: np.ndarray, source: PriorSource = PriorSource.LAST_ANSWER) -> Prior:
    return Prior(source, round(seconds * SECOND), "map", False, pose, None)


def test_from_an_answer_it_goes_on_until_a_prior_comes():
    made = inputs()
    made.take(InputTopic.PRIOR, prior(100, np.eye(4)))
    made.take_answer(answer(100, T_MAP_ODOM), made.for_image(image(100)))
    second = made.for_image(image(105))
    np.testing.assert_array_equal(second.T_map_camera_prior, T_MAP_ODOM)
    assert second.source is PriorSource.LAST_ANSWER
    made.take(InputTopic.PRIOR, prior(105, T_BASE_CAMERA))
    np.testing.assert_allclose(asked(made, 105), T_BASE_CAMERA, atol=1e-12)
    # An answer to the image before is late: the prior came since.
    made.take_answer(answer(105, T_MAP_ODOM), second)
    np.testing.assert_allclose(asked(made, 105), T_BASE_CAMERA, atol=1e-12)


@given(seconds=st.floats(-1000.0, 1000.0))
def test_an_old_answer_means_a_wider_search(seconds):
    made = inputs()
    made.take_answer(answer(2000, T_MAP_ODOM), made.for_image(image(2000)))
    taken = made.for_image(image(2000 + seconds))
    np.testing.assert_array_equal(taken.T_map_camera_prior, T_MAP_ODOM)
    expected = made.policy.growth.by_time(seconds).added_to(made.policy.default_covariance(), False)
    np.testing.assert_allclose(taken.prior_covariance, expected, rtol=1e-4)


def test_after_a_bad_prior_it_does_not_go_on_from_an_answer():
    made = inputs()
    query = made.for_image(image(100))
    with pytest.raises(ValueError, match="must be finite"):
        made.take(InputTopic.PRIOR, prior(100, BAD_POSE))
    made.take_answer(answer(100, T_MAP_ODOM), query)
    with pytest.raises(ValueError, match="must be finite"):
        made.for_image(image(100))


@pytest.mark.parametrize("source", [PriorSource.LAST_ANSWER, PriorSource.UNCONFIRMED, PriorSource.SAVED])
def test_an_own_answer_is_forgotten_but_not_a_prior(source):
    made = inputs()
    made.take(InputTopic.PRIOR, prior(100, T_MAP_ODOM))
    made.forget_answer()
    np.testing.assert_allclose(asked(made, 100), T_MAP_ODOM, atol=1e-12)
    made.take_answer(answer(100, T_MAP_ODOM, source), made.for_image(image(100)))
    made.forget_answer()
    assert made.for_image(image(100)).source is None
    made.take(InputTopic.PRIOR, prior(100, T_MAP_ODOM))
    made.forget_prior()
    assert made.for_image(image(100)).source is None


def test_odometry_carries_the_last_answer_between_images():
    made = inputs()
    assert made.carried_sigma() is None
    made.take_answer(answer(100, np.eye(4)), made.for_image(image(100)))
    assert made.carried_sigma() is None
    drive(made, 99, 120)
    assert made.has_odometry(119 * SECOND)
    assert not made.has_odometry(130 * SECOND)
    assert made.carried_sigma() == pytest.approx(np.hypot(0.5, 2.0), rel=0.01)


def test_a_saved_pose_is_looked_at_first_until_something_comes():
    made = inputs()
    made.start_from(made.policy.saved(T_MAP_ODOM, 5.0))
    taken = made.for_image(image(100))
    assert taken.source is PriorSource.SAVED
    np.testing.assert_array_equal(taken.T_map_camera_prior, T_MAP_ODOM)
    assert position_sigma(taken.prior_covariance) == pytest.approx(5.0)
    made.take(InputTopic.PRIOR, prior(100, np.eye(4)))
    made.start_from(made.policy.saved(T_MAP_ODOM, 5.0))
    assert made.for_image(image(100)).source is PriorSource.PRIOR


def test_of_a_planar_robot_height_and_tilt_are_known():
    made = inputs(planar=True)
    taken = made.for_image(image(100))
    assert taken.source is PriorSource.PLANE
    np.testing.assert_allclose(taken.T_map_camera_prior, T_BASE_CAMERA, atol=1e-12)
    sigmas = np.sqrt(taken.prior_covariance.diagonal())
    assert (sigmas[[0, 1, 5]] >= 1000).all()
    assert (sigmas[[2, 3, 4]] < 0.2).all()


def test_when_time_goes_back_the_future_is_forgotten():
    made = inputs()
    made.take(InputTopic.PRIOR, prior(100, np.eye(4)))
    drive(made, 99, 110)
    made.forget_after(20 * SECOND)
    assert made.for_image(image(20)).source is None
    made.take(InputTopic.PRIOR, prior(19, np.eye(4)))
    made.forget_after(20 * SECOND)
    np.testing.assert_array_equal(asked(made, 20), np.eye(4))


def test_a_request_s_own_camera_and_prior_go_before_what_came():
    made = inputs()
    own = decode_prior(prior(50, T_MAP_ODOM), PriorSource.REQUEST, made.policy)
    np.testing.assert_allclose(made.for_image(image(50), prior=own).T_map_camera_prior, T_MAP_ODOM, atol=1e-12)
    assert made.for_image(image(50)).source is None
    assert position_sigma(made.for_image(image(100), prior=own).prior_covariance) > 50.0


def test_a_request_goes_by_what_had_come_when_it_came():
    made = inputs()
    made.take(InputTopic.PRIOR, prior(100, T_MAP_ODOM))
    arrived = made.newest()
    # Of a time so much later that an image of now would be refused.
    made.take(InputTopic.PRIOR, prior(200, np.eye(4)))
    made.invalidate(InputTopic.CAMERA_INFO, "no camera any more")
    taken = made.for_image(image(100), inputs=arrived)
    np.testing.assert_allclose(taken.T_map_camera_prior, T_MAP_ODOM, atol=1e-12)
    # What came meanwhile is newer than an answer to it.
    made.take_answer(answer(100, T_MAP_ODOM), taken)
    assert made.newest().prior.value.source is PriorSource.PRIOR
    assert made.for_image(image(100), inputs=arrived.without_prior()).source is None
    with pytest.raises(ValueError, match="no camera any more"):
        made.for_image(image(200))


def test_what_was_forgotten_while_a_request_waited_does_not_count():
    made = inputs()
    made.take_answer(answer(100, T_MAP_ODOM), made.for_image(image(100)))
    arrived = made.newest()
    assert made.for_image(image(100), inputs=arrived).source is PriorSource.LAST_ANSWER
    made.forget_answer()
    assert made.for_image(image(100), inputs=arrived).source is None
    made.take(InputTopic.PRIOR, prior(100, T_MAP_ODOM))
    arrived = made.newest()
    made.forget_answer()
    assert made.for_image(image(100), inputs=arrived).source is PriorSource.PRIOR
    made.forget_prior()
    assert made.for_image(image(100), inputs=arrived).source is None


@given(a=poses, b=poses, share=st.floats(0, 1))
def test_interpolation_turns_evenly(a, b, share):
    between = interpolate(a, b, share)
    turn, part = (so3_log(a[:3, :3].T @ pose[:3, :3]) for pose in (b, between))
    # Half a turn may go either way round.
    if np.linalg.norm(turn) < 3.1:
        np.testing.assert_allclose(part, share * turn, atol=1e-6)
    np.testing.assert_allclose(between[:3, 3], a[:3, 3] + share * (b[:3, 3] - a[:3, 3]), atol=1e-9)
    np.testing.assert_allclose(between @ invert(between), np.eye(4), atol=1e-9)


def test_odometry_of_no_body_is_refused_and_the_prior_still_serves():
    made = inputs()
    made.take(InputTopic.PRIOR, prior(1, np.eye(4)))
    with pytest.raises(ValueError, match=r"^odom has no child_frame_id"):
        made.take(InputTopic.ODOMETRY, odometry(1, np.eye(4), child=""))
    np.testing.assert_array_equal(asked(made, 1), np.eye(4))


@given(pose=poses)
def test_odometry_as_a_prior_is_of_its_child_frame(pose):
    made = inputs(of_base=False)
    made.take(InputTopic.PRIOR, odometry(1, pose))
    np.testing.assert_allclose(asked(made, 1), T_MAP_ODOM @ pose @ T_BASE_CAMERA, atol=1e-9)
    made.take(InputTopic.PRIOR, odometry(1, pose, child="camera"))
    np.testing.assert_allclose(asked(made, 1), T_MAP_ODOM @ pose, atol=1e-9)
    with pytest.raises(ValueError, match=r"^prior has no child_frame_id"):
        made.take(InputTopic.PRIOR, odometry(1, pose, child=""))


def test_the_covariance_of_odometry_as_a_prior_counts():
    made, message = inputs(), odometry(1, np.eye(4), child="camera")
    message.header.frame_id, message.pose.covariance = "map", np.diag([1.0, 2, 3, 4, 5, 6]).ravel().tolist()
    made.take(InputTopic.PRIOR, message)
    np.testing.assert_array_equal(made.for_image(image(1)).prior_covariance, np.diag([1.0, 2, 3, 4, 5, 6]))


@pytest.mark.parametrize("unknown", [np.nan, -1.0])
def test_a_covariance_that_is_said_to_be_unknown_is_none(unknown):
    made = inputs()
    made.take(InputTopic.PRIOR, prior(1, np.eye(4), "map", np.diag([unknown, 1, 1, 1, 1, 1.0])))
    assert made.for_image(image(1)).prior_covariance is None


def test_a_slash_before_a_frame_does_not_matter():
    made = inputs(of_base=True)
    drive(made, 0, 2)
    made.take(InputTopic.ODOMETRY, odometry(2.05, make_pose(np.eye(3), [2.05, 0, 0]), child="/base_link"))
    made.take(InputTopic.PRIOR, prior(1, np.eye(4), "/odom"))
    expected = T_MAP_ODOM @ make_pose(np.eye(3), [1, 0, 0]) @ T_BASE_CAMERA
    np.testing.assert_allclose(asked(made, 2, "/camera"), expected, atol=1e-9)


def test_odometry_of_another_frame_begins_anew():
    made = inputs()
    drive(made, 0, 2)
    assert made.has_odometry(SECOND)
    other = odometry(2.05, np.eye(4))
    other.header.frame_id = "visual_odom"
    made.take(InputTopic.ODOMETRY, other)
    assert not made.has_odometry(SECOND)
