"""What each way of finding an alignment does with the options of the command line, whose names are theirs.

`map_given` among them is where the map lies by options, a MapSettings.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from tqdm import tqdm

from gsfeatloc_ros.align.alignment import Alignment
from gsfeatloc_ros.align.determination import Precision, check, report
from gsfeatloc_ros.align.distance import MapPoint, point_at, scale_by_distance
from gsfeatloc_ros.align.fit import fit_drive
from gsfeatloc_ros.align.gravity import up_by_imu, up_of_level_camera
from gsfeatloc_ros.align.level import level
from gsfeatloc_ros.align.localized import localize_bag
from gsfeatloc_ros.align.pairs import Answer, match
from gsfeatloc_ros.align.pose_files import read_answers, read_tum
from gsfeatloc_ros.align.robot_path import RobotPath
from gsfeatloc_ros.align.target import Checkerboard, Tags, Target
from gsfeatloc_ros.align.target_fit import fit_targets, scale_by_targets
from gsfeatloc_ros.align.views import views_of_bag, views_of_scene
from gsfeatloc_ros.common.geometry import pose_from_numbers
from gsfeatloc_ros.common.parameter import values_of
from gsfeatloc_ros.localize.engine import load_renderer
from gsfeatloc_ros.localize.settings import MapSettings, MatcherSettings, RendererSettings
from gsfeatloc_ros.maps import load_map
from gsfeatloc_ros.replay.bag import Role
from gsfeatloc_ros.replay.truth import Trajectory
from gsfeatloc_ros.ros_io.calibration import decode_camera
from gsfeatloc_ros.ros_io.calibration_file import read_calibration
from gsfeatloc_ros.ros_io.parameter_file import read_parameter_file
from gsfeatloc_ros.ros_io.settings import Settings

# Stamps in nanoseconds and T_robot_camera (4, 4).
Poses = list[tuple[int, np.ndarray]]


def by_trajectory(options: argparse.Namespace) -> Alignment:
    """Fit answers that are there to a trajectory."""
    return _fitted(options, _trajectory(options), read_answers(options.answers))


def by_drive(options: argparse.Namespace) -> Alignment:
    """Localize the photos of a bag, and fit the answers to a trajectory."""
    map_, trajectory = named_map(options), _trajectory(options)
    if not options.camera_info and not options.calibration:
        raise ValueError("name the topic of camera_info, or a file with the calibration: --camera-info, --calibration")
    topics = {Role.IMAGE: options.image, Role.CAMERA_INFO: options.camera_info, Role.PRIOR: options.prior}
    settings = Settings(map=map_, matcher=MatcherSettings(options.matcher, options.weights))
    settings = replace(settings, node=replace(settings.node, max_rate=options.max_rate))
    settings = replace(settings, index=replace(settings.index, build=not options.prior))
    settings = replace(settings, image=replace(settings.image, rectified=options.rectified))
    calibration = read_calibration(options.calibration, options.rectified) if options.calibration else None
    named = {role: [topic] for role, topic in topics.items() if topic}
    with tqdm(localize_bag(options.bag, named, settings, calibration), unit="photo", disable=None) as progress:
        tried = list(progress)
    answers = [answer for answer in tried if answer is not None]
    print(f"localized {len(answers)} of {len(tried)} photos in the map as it lies now")
    return _fitted(options, trajectory, answers)


def _trajectory(options: argparse.Namespace) -> Callable[[Sequence[Answer]], Poses]:
    """Return what gives the robot's trajectory that the options name, for answers.

    What is of no use in it is said now: the answers of a drive take minutes.
    """
    mounted = _pose("--extrinsics", options.extrinsics)
    path = None
    if options.bag:
        path = RobotPath(options.bag, options.odom, options.frame, options.camera_frame, options.image, mounted)
    if options.trajectory:
        poses = read_tum(options.trajectory)
        if options.body:
            if path is None:
                raise ValueError("--body: name the bag whose tf tells where the camera is on it: --bag")
            mounted = path.mounted(options.body)
        poses = poses if mounted is None else [(stamp, pose @ mounted) for stamp, pose in poses]
    elif path is None:
        raise ValueError("name the robot's trajectory: --trajectory FILE, or --bag BAG with --odom or --frame")
    elif options.odom:
        poses = path.read([])
    else:
        return lambda answers: path.read([answer.stamp for answer in answers])
    return lambda answers: poses


def _fitted(
    options: argparse.Namespace, trajectory: Callable[[Sequence[Answer]], Poses], answers: Sequence[Answer]
) -> Alignment:
    """Fit answers to a trajectory."""
    pairs = match(answers, Trajectory(trajectory(answers), options.max_gap), oriented=not options.positions_only)
    fit = fit_drive(pairs, options.seed)
    check(fit, Precision(options.max_scale_sd / 100, options.max_angle_sd))
    return Alignment(fit.S_robot_map, complete=True, report=list(report(fit)))


def by_gravity(options: argparse.Namespace) -> Alignment:
    """Level the map by an IMU or a level camera, and find its floor."""
    map_, answers = named_map(options), read_answers(options.answers)
    if options.level == bool(options.imu):
        raise ValueError("say what tells up: --bag BAG with --imu TOPIC, or --level for a camera that is mounted level")
    if options.level:
        up = up_of_level_camera(answers)
    else:
        if not options.bag:
            raise ValueError("name the bag that has the IMU: --bag")
        mounted = _pose("--extrinsics", options.extrinsics)
        path = RobotPath(options.bag, "", "", options.camera_frame, options.image, mounted)
        up = up_by_imu(answers, path, options.imu)
    gaussians = load_map(map_.path, map_.alignment(), map_.reading)
    return level(up, gaussians, answers, options.up == "floor", options.metres)


def by_distance(options: argparse.Namespace) -> Alignment:
    """Scale the map by two points of it."""
    if bool(options.points) == bool(options.pixels):
        raise ValueError("name two points: --points X Y Z X Y Z, or --pixels STAMP U V STAMP U V")
    if options.points:
        first, second = (MapPoint(position, np.zeros(3)) for position in np.array(options.points).reshape(2, 3))
        return scale_by_distance((first, second), options.distance)
    if not (options.answers and options.calibration):
        raise ValueError("--pixels needs --answers, --calibration and --map")
    answers, camera = read_answers(options.answers), decode_camera(read_calibration(options.calibration))
    renderer = load_renderer(named_map(options), RendererSettings())
    first, second = (
        point_at(renderer, camera, answers, round(1e9 * stamp), np.array([u, v]))
        for stamp, u, v in np.array(options.pixels).reshape(2, 3)
    )
    return scale_by_distance((first, second), options.distance)


def by_target(options: argparse.Namespace) -> Alignment:
    """Scale, or place, the map by targets in photos."""
    if bool(options.tag) == bool(options.checkerboard):
        raise ValueError("name the target: --tag FAMILY, or --checkerboard COLUMNS ROWS (inner corners)")
    if options.tag_pose is not None and not options.tag:
        raise ValueError("--tag-pose: a checkerboard may be seen either way round: use a tag")
    target: Target
    if options.tag:
        target = Tags(options.tag, options.size, options.tag_id)
    else:
        columns, rows = options.checkerboard
        target = Checkerboard(columns, rows, options.size)
    if options.scene:
        views = views_of_scene(options.scene, map_now(options).alignment())
    else:
        if not (options.bag and options.image and options.answers):
            raise ValueError("name the photos: --scene SCENE, or --bag BAG with --image TOPIC and --answers FILE")
        calibration = read_calibration(options.calibration, options.rectified) if options.calibration else None
        topics = {Role.IMAGE: [options.image]}
        if options.camera_info:
            topics[Role.CAMERA_INFO] = [options.camera_info]
        views = views_of_bag(options.bag, topics, read_answers(options.answers), calibration, options.rectified)
    fit = fit_targets(target, [sighting for view in views for sighting in target.find(view)])
    return scale_by_targets(fit, options.max_scale_sd / 100, _pose("--tag-pose", options.tag_pose))


def map_now(options: argparse.Namespace) -> MapSettings:
    """Return where the map lies now: by a parameter file, and by options where these are not the default."""
    values = read_parameter_file(options.params_file) if options.params_file else {}
    given, default = values_of(options.map_given, "map."), values_of(MapSettings(), "map.")
    values |= {name: value for name, value in given.items() if value != default[name]}
    return Settings.checked(values).map.resolved()


def named_map(options: argparse.Namespace) -> MapSettings:
    """Return the same of a map that has to be named."""
    map_ = map_now(options)
    if not map_.path:
        raise ValueError("name the map: --map")
    return map_


def _pose(option: str, values: Sequence[float] | None) -> np.ndarray | None:
    """Return the pose (4, 4) that an option names, if it is given."""
    if values is None:
        return None
    try:
        return pose_from_numbers(values)
    except ValueError as error:
        raise ValueError(f"{option}: {error}") from error
