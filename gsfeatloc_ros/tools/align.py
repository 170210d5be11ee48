"""Find where a map's frame lies in the robot's, and write the parameters map.* for the node.

    gsfeatloc align trajectory --answers answers.csv --trajectory odometry.tum --out map.yaml
    gsfeatloc align drive BAG --map map.ply --image /camera/image_raw \\
        --camera-info /camera/camera_info --odom /odom --out map.yaml

trajectory takes answers that are there already (replay's answers.csv, or a TUM file), drive localizes the photos of a
bag first. docs/frames.md says which way suits whom. Where the map lies by --map-scale and so on counts: the answers are
given there.

The exit status is 1, and nothing is written, where the data do not determine what is asked, 2 where something cannot be
used.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from gsfeatloc_ros.align.alignment import Alignment, write_parameters
from gsfeatloc_ros.align.determination import Precision, check, report
from gsfeatloc_ros.align.fit import UndeterminedError, fit_drive
from gsfeatloc_ros.align.localized import localize_bag
from gsfeatloc_ros.align.pairs import Answer, match
from gsfeatloc_ros.align.pose_files import read_answers, read_tum
from gsfeatloc_ros.align.robot_path import RobotPath
from gsfeatloc_ros.common.geometry import make_pose, matrix_from_quaternion
from gsfeatloc_ros.common.kernel_cache import can_write
from gsfeatloc_ros.localize.settings import MapSettings, MatcherSettings
from gsfeatloc_ros.match import MATCHERS
from gsfeatloc_ros.replay.bag import Role
from gsfeatloc_ros.replay.truth import MAX_GAP, Trajectory
from gsfeatloc_ros.ros_io.calibration_file import read_calibration
from gsfeatloc_ros.ros_io.settings import Settings
from gsfeatloc_ros.tools.options import add_map_options, map_settings, number
from gsfeatloc_ros.tools.status import run_tool

# The exit status where the data do not determine what is asked.
UNDETERMINED = 1
_POSE = ("X", "Y", "Z", "QX", "QY", "QZ", "QW")


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status.

    It is 0 when the parameters were written, 1 where the data do not determine them, 2 when something cannot be used
    and 130 when the user interrupted it.
    """
    options = make_parser().parse_args(arguments)
    return run_tool("align", lambda: _align(options))


def _align(options: argparse.Namespace) -> int:
    # Now, not after minutes.
    if options.out.is_dir() or not can_write(options.out.absolute().parent):
        raise ValueError(f"{options.out}: cannot be written: name another file (--out)")
    try:
        alignment: Alignment = options.run(options)
    except UndeterminedError as error:
        print(f"align: {error}; nothing is written", file=sys.stderr)
        return UNDETERMINED
    map_ = alignment.applied_to(_map(options))
    about = f"where the map lies in the robot's frame, by gsfeatloc align {options.way}"
    write_parameters(options.out, map_, [about, *alignment.report])
    print("\n".join(alignment.report))
    print(f"wrote {options.out}")
    return 0


def _trajectory(options: argparse.Namespace) -> Alignment:
    return _fitted(options, read_answers(options.answers))


def _drive(options: argparse.Namespace) -> Alignment:
    if not options.map:
        raise ValueError("name the map that the photos are to be localized in: --map")
    if not options.camera_info and not options.calibration:
        raise ValueError("name the topic of camera_info, or a file with the calibration: --camera-info, --calibration")
    topics = {Role.IMAGE: options.image, Role.CAMERA_INFO: options.camera_info, Role.PRIOR: options.prior}
    settings = Settings(map=_map(options), matcher=MatcherSettings(options.matcher, options.weights))
    settings = replace(settings, node=replace(settings.node, max_rate=options.max_rate))
    settings = replace(settings, index=replace(settings.index, build=not options.prior))
    settings = replace(settings, image=replace(settings.image, rectified=options.rectified))
    calibration = read_calibration(options.calibration) if options.calibration else None
    named = {role: [topic] for role, topic in topics.items() if topic}
    with tqdm(localize_bag(options.bag, named, settings, calibration), unit="photo", disable=None) as progress:
        tried = list(progress)
    answers = [answer for answer in tried if answer is not None]
    print(f"localized {len(answers)} of {len(tried)} photos in the map as it lies now")
    return _fitted(options, answers)


def _fitted(options: argparse.Namespace, answers: Sequence[Answer]) -> Alignment:
    """Fit the answers to the trajectory that the options name."""
    mounted = None if options.extrinsics is None else _pose("--extrinsics", options.extrinsics)
    if options.trajectory:
        poses = read_tum(options.trajectory)
        poses = poses if mounted is None else [(stamp, pose @ mounted) for stamp, pose in poses]
    elif options.bag:
        path = RobotPath(options.bag, options.odom, options.frame, options.camera_frame, options.image, mounted)
        poses = path.read([answer.stamp for answer in answers])
    else:
        raise ValueError("name the robot's trajectory: --trajectory FILE, or --bag BAG with --odom or --frame")
    pairs = match(answers, Trajectory(poses, options.max_gap), oriented=not options.positions_only)
    fit = fit_drive(pairs, options.seed)
    check(fit, Precision(options.max_scale_sd / 100, options.max_angle_sd))
    return Alignment(fit.S_robot_map, complete=True, report=list(report(fit)))


def _map(options: argparse.Namespace) -> MapSettings:
    return replace(map_settings(options), path=str(options.map or ""))


def _pose(option: str, values: Sequence[float]) -> np.ndarray:
    try:
        return make_pose(matrix_from_quaternion(values[3:]), values[:3])
    except ValueError as error:
        raise ValueError(f"{option}: {error}") from error


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog="gsfeatloc align", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    ways = parser.add_subparsers(dest="way", required=True, metavar="WAY")
    way = ways.add_parser("trajectory", help="answers that are there already against the robot's trajectory")
    way.set_defaults(run=_trajectory)
    way.add_argument("--answers", type=Path, required=True, metavar="FILE", help="replay's answers.csv, or TUM")
    way.add_argument("--bag", type=Path, help="rosbag2 with odometry or tf, instead of --trajectory")
    way.add_argument("--image", metavar="TOPIC", default="", help="of the bag, whose images name the camera's frame")
    _add_trajectory(way)
    _add_common(way)
    way = ways.add_parser("drive", help="the photos of a bag, localized here, against the robot's trajectory")
    way.set_defaults(run=_drive)
    way.add_argument("bag", type=Path, help="folder of a rosbag2, or an .mcap or .db3 file")
    _add_photos(way)
    _add_trajectory(way)
    _add_common(way)
    return parser


def _add_photos(way: argparse.ArgumentParser) -> None:
    matcher = MatcherSettings()
    way.add_argument("--image", metavar="TOPIC", required=True, help="sensor_msgs/Image or CompressedImage")
    way.add_argument("--camera-info", metavar="TOPIC", help="sensor_msgs/CameraInfo")
    way.add_argument("--calibration", type=Path, metavar="FILE", help="of a bag without camera_info")
    way.add_argument("--rectified", action="store_true", help="the images are rectified, as image.rectified")
    way.add_argument(
        "--prior",
        metavar="TOPIC",
        help="priors in the map's frame as it lies now; without them an index of views is made",
    )
    way.add_argument(
        "--max-rate", type=number(float, 0), default=1.0, metavar="HZ", help="photos a second (default: %(default)g)"
    )
    way.add_argument("--matcher", choices=sorted(MATCHERS), default=matcher.name, help="default: %(default)s")
    way.add_argument("--weights", default="", metavar="PATH", help="of a learned matcher, as matcher.weights")


def _add_trajectory(way: argparse.ArgumentParser) -> None:
    precision = Precision()
    group = way.add_argument_group("the robot's trajectory")
    group.add_argument("--trajectory", type=Path, metavar="FILE", help="TUM: stamp x y z qx qy qz qw, in metres")
    group.add_argument("--odom", metavar="TOPIC", default="", help="nav_msgs/Odometry of the bag; without it, tf")
    group.add_argument("--frame", default="odom", metavar="NAME", help="robot's frame in tf (default: %(default)s)")
    group.add_argument("--camera-frame", default="", metavar="NAME", help="default: that of the bag's images")
    group.add_argument(
        "--extrinsics",
        type=number(float, -np.inf),
        nargs=7,
        metavar=_POSE,
        help="pose of the camera's optical frame in the body that the trajectory is of (default: tf; of a file, none)",
    )
    group.add_argument("--positions-only", action="store_true", help="the trajectory's orientations are not to be used")
    group.add_argument(
        "--max-gap",
        type=number(float, 0),
        default=MAX_GAP,
        metavar="SECONDS",
        help="longest time between two poses between which is interpolated (default: %(default)g)",
    )
    group.add_argument(
        "--max-scale-sd",
        type=number(float, 0),
        default=100 * precision.scale,
        metavar="PERCENT",
        help="largest standard deviation of the scale (default: %(default)g)",
    )
    group.add_argument(
        "--max-angle-sd",
        type=number(float, 0),
        default=precision.angle,
        metavar="DEGREES",
        help="largest standard deviation of the rotation (default: %(default)g)",
    )
    group.add_argument("--seed", type=number(int, 0), default=0, help="of RANSAC")


def _add_common(way: argparse.ArgumentParser) -> None:
    way.add_argument("--out", type=Path, required=True, metavar="FILE", help="parameter file to write")
    way.add_argument("--map", type=Path, help="the Gaussian Splatting map, as map.path")
    add_map_options(way)


if __name__ == "__main__":
    sys.exit(main())
