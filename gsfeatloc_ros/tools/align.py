"""Find where a map's frame lies in the robot's, and write the parameters map.* for the node.

    gsfeatloc align trajectory --answers answers.csv --trajectory odometry.tum --out map.yaml
    gsfeatloc align drive BAG --map map.ply --image /camera/image_raw \\
        --camera-info /camera/camera_info --odom /odom --out map.yaml
    gsfeatloc align gravity --map map.ply --answers answers.csv --bag BAG --imu /imu --out map.yaml
    gsfeatloc align distance --points 0 0 0 1 0.5 0 --distance 1.72 --out map.yaml
    gsfeatloc align target --scene SCENE --tag 36h11 --size 0.16 --out map.yaml

trajectory takes answers that are there already (replay's answers.csv, or a TUM file), drive localizes the photos of a
bag first; both find the whole similarity. gravity finds roll, pitch and the floor, distance and target the scale.
docs/frames.md says which way suits whom. Where the map lies already, by --params-file (of a step before) or --map-scale
and so on, counts: answers, points and poses are given there.

The exit status is 1, and nothing is written, where the data do not determine what is asked, 2 where something cannot be
used.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsfeatloc_ros.align.alignment import Alignment, write_parameters
from gsfeatloc_ros.align.determination import Precision
from gsfeatloc_ros.align.fit import UndeterminedError
from gsfeatloc_ros.align.target import FAMILIES
from gsfeatloc_ros.align.ways import by_distance, by_drive, by_gravity, by_target, by_trajectory, map_now
from gsfeatloc_ros.localize.settings import MatcherSettings
from gsfeatloc_ros.match import MATCHERS
from gsfeatloc_ros.replay.truth import MAX_GAP
from gsfeatloc_ros.tools.options import add_map_options, check_outputs, map_settings, number
from gsfeatloc_ros.tools.status import run_tool

# The exit status where the data do not determine what is asked.
UNDETERMINED = 1
_FINITE = number(float, -np.inf)
_POSE = ("X", "Y", "Z", "QX", "QY", "QZ", "QW")


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status.

    It is 0 when the parameters were written, 1 where the data do not determine them, 2 when something cannot be used
    and 130 when the user interrupted it.
    """
    options = make_parser().parse_args(arguments)
    return run_tool("align", lambda: _align(options))


def _align(options: argparse.Namespace) -> int:
    options.map_given = replace(map_settings(options), path=str(options.map or ""))
    check_outputs(options.out)
    try:
        alignment: Alignment = options.run(options)
    except UndeterminedError as error:
        print(f"align: {error}; nothing is written", file=sys.stderr)
        return UNDETERMINED
    map_ = alignment.applied_to(map_now(options))
    about = f"where the map lies in the robot's frame, by gsfeatloc align {options.way}"
    write_parameters(options.out, map_, [about, *alignment.report])
    print("\n".join(alignment.report))
    print(f"wrote {options.out}")
    return 0


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog="gsfeatloc align", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    ways = parser.add_subparsers(dest="way", required=True, metavar="WAY")
    way = ways.add_parser("trajectory", help="answers that are there already against the robot's trajectory")
    way.set_defaults(run=by_trajectory)
    _add_answers(way)
    way.add_argument("--bag", type=Path, help="rosbag2 with odometry or tf, instead of --trajectory")
    way.add_argument("--image", metavar="TOPIC", default="", help="of the bag, whose images name the camera's frame")
    _add_trajectory(way)
    _add_common(way)
    way = ways.add_parser("drive", help="the photos of a bag, localized here, against the robot's trajectory")
    way.set_defaults(run=by_drive)
    way.add_argument("bag", type=Path, help="folder of a rosbag2, or an .mcap or .db3 file")
    _add_photos(way)
    _add_trajectory(way)
    _add_common(way)
    _add_gravity(ways.add_parser("gravity", help="what is up, and where the floor is: roll, pitch, height"))
    _add_distance(ways.add_parser("distance", help="one distance that is known: the scale"))
    _add_target(ways.add_parser("target", help="an AprilTag or a checkerboard in the photos: the scale"))
    return parser


def _add_gravity(way: argparse.ArgumentParser) -> None:
    way.set_defaults(run=by_gravity)
    _add_answers(way)
    way.add_argument("--bag", type=Path, help="rosbag2 with the IMU")
    way.add_argument("--imu", metavar="TOPIC", default="", help="sensor_msgs/Imu of the bag")
    way.add_argument("--image", metavar="TOPIC", default="", help="of the bag, whose images name the camera's frame")
    way.add_argument("--camera-frame", default="", metavar="NAME", help="instead of --image")
    way.add_argument(
        "--extrinsics", type=_FINITE, nargs=7, metavar=_POSE, help="pose of the camera in the IMU's frame (default: tf)"
    )
    way.add_argument("--level", action="store_true", help="the camera is mounted level: the rows of photos are")
    way.add_argument(
        "--up",
        choices=("gravity", "floor"),
        default="gravity",
        help="what roll and pitch are taken from in the end (default: %(default)s)",
    )
    way.add_argument("--metres", action="store_true", help="the unit is the metre already: writes map.aligned")
    _add_common(way)


def _add_distance(way: argparse.ArgumentParser) -> None:
    way.set_defaults(run=by_distance)
    way.add_argument("--distance", type=number(float, 1e-6), required=True, metavar="METRES")
    way.add_argument("--points", type=_FINITE, nargs=6, metavar=("X", "Y", "Z") * 2, help="two points of the map")
    way.add_argument(
        "--pixels", type=_FINITE, nargs=6, metavar=("STAMP", "U", "V") * 2, help="two pixels of photos, as observed"
    )
    way.add_argument("--answers", type=Path, metavar="FILE", help="where the photos of --pixels were taken")
    way.add_argument("--calibration", type=Path, metavar="FILE", help="of the camera of --pixels")
    _add_common(way)


def _add_target(way: argparse.ArgumentParser) -> None:
    way.set_defaults(run=by_target)
    way.add_argument("--tag", choices=sorted(FAMILIES), help="family of the AprilTags")
    way.add_argument("--tag-id", type=number(int, 0), metavar="N", help="only this one (default: all)")
    way.add_argument("--checkerboard", type=number(int, 3), nargs=2, metavar=("COLUMNS", "ROWS"), help="inner corners")
    way.add_argument(
        "--size", type=number(float, 1e-6), required=True, metavar="METRES", help="side of the tag, or of a square"
    )
    way.add_argument(
        "--tag-pose",
        type=_FINITE,
        nargs=7,
        metavar=_POSE,
        help="pose of the tag in the robot's frame: then the whole similarity is found",
    )
    way.add_argument(
        "--scene", type=Path, help="photos with known poses, as for evaluate, in the frame of the map's file"
    )
    way.add_argument("--bag", type=Path, help="rosbag2 with photos that were localized, instead of --scene")
    way.add_argument("--image", metavar="TOPIC", help="of the bag")
    way.add_argument("--camera-info", metavar="TOPIC", help="of the bag")
    way.add_argument("--calibration", type=Path, metavar="FILE", help="of a bag without camera_info")
    way.add_argument("--rectified", action="store_true", help="the images of the bag are rectified")
    way.add_argument("--answers", type=Path, metavar="FILE", help="where the photos of the bag were taken")
    _add_scale_limit(way)
    _add_common(way)


def _add_answers(way: argparse.ArgumentParser) -> None:
    way.add_argument("--answers", type=Path, required=True, metavar="FILE", help="replay's answers.csv, or TUM")


def _add_scale_limit(way: argparse._ActionsContainer) -> None:
    way.add_argument(
        "--max-scale-sd",
        type=number(float, 0),
        default=100 * Precision().scale,
        metavar="PERCENT",
        help="largest standard deviation of the scale (default: %(default)g)",
    )


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
    group = way.add_argument_group("the robot's trajectory")
    group.add_argument("--trajectory", type=Path, metavar="FILE", help="TUM: stamp x y z qx qy qz qw, in metres")
    group.add_argument("--odom", metavar="TOPIC", default="", help="nav_msgs/Odometry of the bag; without it, tf")
    group.add_argument("--frame", default="odom", metavar="NAME", help="robot's frame in tf (default: %(default)s)")
    group.add_argument("--camera-frame", default="", metavar="NAME", help="default: that of the bag's images")
    group.add_argument(
        "--body", default="", metavar="NAME", help="frame that the poses of --trajectory are of (default: the camera's)"
    )
    group.add_argument(
        "--extrinsics",
        type=_FINITE,
        nargs=7,
        metavar=_POSE,
        help="pose of the camera's optical frame in the body that the trajectory is of (default: tf of the bag; of a "
        "file without --body, none)",
    )
    group.add_argument("--positions-only", action="store_true", help="the trajectory's orientations are not to be used")
    group.add_argument(
        "--max-gap",
        type=number(float, 0),
        default=MAX_GAP,
        metavar="SECONDS",
        help="longest time between two poses between which is interpolated (default: %(default)g)",
    )
    _add_scale_limit(group)
    group.add_argument(
        "--max-angle-sd",
        type=number(float, 0),
        default=Precision().angle,
        metavar="DEGREES",
        help="largest standard deviation of the rotation (default: %(default)g)",
    )
    group.add_argument("--seed", type=number(int, 0), default=0, help="of RANSAC")


def _add_common(way: argparse.ArgumentParser) -> None:
    way.add_argument("--out", type=Path, required=True, metavar="FILE", help="parameter file to write")
    way.add_argument("--map", type=Path, help="the Gaussian Splatting map, as map.path")
    way.add_argument(
        "--params-file", type=Path, metavar="FILE", help="where the map lies now, as a step before wrote it"
    )
    add_map_options(way)


if __name__ == "__main__":
    sys.exit(main())
