"""Localize the images of a recorded bag, without a ROS graph, as the node would.

    gsfeatloc replay BAG --map room.ply --image /camera/image_raw \\
        --camera-info /camera/camera_info --prior /prior --truth /ground_truth --out replayed

BAG is a rosbag2: its folder, or an .mcap or .db3 file. Into the folder of --out go answers.tum, answers.csv (a line for
each image), the bag `answers` (geometry_msgs/PoseWithCovarianceStamped on /pose), and with --truth errors.png.

It is what the node does, by the same code: parameters are the node's (--params-file, -p), and so are tf, odometry,
state and index. The truth is compared at the stamp of the image, between two poses that are not more than 0.25 s apart.
The exit status is 3 where nothing was localized.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from tqdm import tqdm

from gsfeatloc_ros.common.threads import limit_threads
from gsfeatloc_ros.common.words import in_one_line
from gsfeatloc_ros.evaluate.extras import import_extra
from gsfeatloc_ros.localize.engine import Engine, load_engine
from gsfeatloc_ros.localize.map_index import index_for, index_key
from gsfeatloc_ros.localize.options import LocalizerOptions
from gsfeatloc_ros.localize.settings import MatcherSettings
from gsfeatloc_ros.match import MATCHERS
from gsfeatloc_ros.replay.bag import Role, open_bag
from gsfeatloc_ros.replay.bag_files import BagError
from gsfeatloc_ros.replay.figure import write_figure
from gsfeatloc_ros.replay.output import write_bag, write_csv, write_tum
from gsfeatloc_ros.replay.run import Replay, ReplayedImage
from gsfeatloc_ros.replay.summary import summary
from gsfeatloc_ros.replay.truth import Trajectory
from gsfeatloc_ros.ros_io.calibration_file import read_calibration
from gsfeatloc_ros.ros_io.parameter_file import read_parameter_file
from gsfeatloc_ros.ros_io.prior import PriorPolicy
from gsfeatloc_ros.ros_io.settings import Settings
from gsfeatloc_ros.tools.options import (
    CollectSettings,
    add_map_options,
    add_node_parameters,
    given_map,
    localizer_options,
    number,
    print_reading,
    setting,
)
from gsfeatloc_ros.tools.status import INTERRUPTED, UNUSABLE, run_tool

# The exit status when no image was localized.
NOTHING_LOCALIZED = 3
# Parameters of the node that mean nothing in a replay.
_WITHOUT_EFFECT = ("autostart", "image.transport", "image.timeout", "state.path", "transform_tolerance")


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status.

    It is 0 when all images were tried, 3 when none of them was localized, 2 when something cannot be used and 130 when
    the user interrupted it. What came before a damage of the bag or an interruption is written.
    """
    options = make_parser().parse_args(arguments)
    return run_tool("replay", lambda: _replay(options))


def _replay(options: argparse.Namespace) -> int:
    if options.out.exists() and (not options.out.is_dir() or any(options.out.iterdir())):
        raise ValueError(f"{options.out}: is there already: name a new or an empty folder")
    if options.truth:
        import_extra("matplotlib")  # to say now, not after an hour, that it is missing
    settings = _settings(options)
    limit_threads(settings.cpu.threads)
    calibration = read_calibration(options.calibration, settings.image.rectified) if options.calibration else None
    with open_bag(options.bag, _topics(options, settings)) as bag:
        replay = Replay(bag, _engine(settings), settings, calibration)
        options.out.mkdir(parents=True, exist_ok=True)
        start = time.monotonic()
        images, status = _collect(replay, bag.images)
        seconds = time.monotonic() - start
    truth = Trajectory(replay.truth) if options.truth else None
    write_tum(options.out / "answers.tum", images)
    write_csv(options.out / "answers.csv", images, truth)
    write_bag(options.out / "answers", bag.storage, images, settings.map.frame_id)
    if truth is not None:
        write_figure(options.out / "errors.png", images, truth, settings.map)
    print(summary(bag, replay, images, truth, seconds))
    print(f"wrote {options.out}")
    if not status and not any(image.outcome.localized for image in images):
        print("replay: nothing was localized", file=sys.stderr)
        return NOTHING_LOCALIZED
    return status


def _collect(replay: Replay, count: int) -> tuple[list[ReplayedImage], int]:
    """Return all images and 0, or those up to where it ended too early and the exit status for that."""
    images: list[ReplayedImage] = []
    localized = 0
    try:
        with tqdm(replay.images(), total=count, unit="image") as progress:
            for image in progress:
                images.append(image)
                localized += image.outcome.localized
                progress.set_postfix_str(f"{localized} localized", refresh=False)
    except BagError as error:
        print(f"replay: {in_one_line(error)}", file=sys.stderr)
        return images, UNUSABLE
    except KeyboardInterrupt:
        print("replay: interrupted", file=sys.stderr)
        return images, INTERRUPTED
    return images, 0


def _settings(options: argparse.Namespace) -> Settings:
    """Return the node's settings as the options have them: a parameter file, what -p sets, options of their own.

    Raises:
        ValueError: there is no such parameter, it does not take such a value, or it needs a map that is aligned.
    """
    values = read_parameter_file(options.params_file) if options.params_file else {}
    values |= dict(options.parameter)
    values |= given_map(options)
    own = {
        "prior_max_age": options.prior_max_age,
        "image.rectified": options.rectified or None,
        "matcher.name": options.matcher,
        "matcher.weights": options.weights,
        "localizer.seed": options.seed,
        "localizer.max_image_width": options.max_width,
    }
    values |= {name: value for name, value in own.items() if value is not None}
    values |= {f"localizer.{name}": value for name, value in options.set.items()}
    settings = Settings.checked(values, _say).resolved()
    settings.check_plane()
    for name in _WITHOUT_EFFECT:
        if name in values:
            _say(f"parameter {name} has no effect here")
    return settings


def _say(notice: str) -> None:
    print(f"replay: {notice}", file=sys.stderr)


def _topics(options: argparse.Namespace, settings: Settings) -> dict[Role, list[str]]:
    """Return the topics of each role; raise ValueError where something needed has none, or one is of no use."""
    if not options.camera_info and not options.calibration:
        raise ValueError("name the topic of camera_info, or a file with the calibration: --camera-info, --calibration")
    if options.odom and not settings.node.track:
        raise ValueError("--odom: odometry is taken only with track, as by the node: add -p track:=true")
    topics = {
        Role.IMAGE: options.image,
        Role.CAMERA_INFO: options.camera_info,
        Role.PRIOR: options.prior,
        Role.INITIAL_POSE: options.initialpose,
        Role.ODOMETRY: options.odom,
        Role.TF: options.tf,
        Role.TF_STATIC: options.tf_static,
        Role.TRUTH: options.truth,
    }
    return {role: names if isinstance(names, list) else [names] for role, names in topics.items() if names}


def _engine(settings: Settings) -> Engine:
    """Load what localizes, and the index of the map's views."""
    engine = load_engine(settings.map, settings.matcher, settings.renderer, settings.localizer)
    print_reading("replay", engine.renderer)
    key = index_key(engine.map_path, settings.map, settings.matcher, settings.index)
    return engine.with_index(index_for(engine, settings.index, key))


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog="gsfeatloc replay", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    matcher, localizer = MatcherSettings(), LocalizerOptions()
    parser.add_argument("bag", type=Path, help="folder of a rosbag2, or an .mcap or .db3 file")
    parser.add_argument("--map", type=Path, help="the Gaussian Splatting map, as map.path")
    parser.add_argument("--image", metavar="TOPIC", required=True, help="sensor_msgs/Image or CompressedImage")
    parser.add_argument("--camera-info", metavar="TOPIC", help="sensor_msgs/CameraInfo")
    parser.add_argument(
        "--calibration", type=Path, metavar="FILE", help="of a bag without camera_info, as camera_calibration writes it"
    )
    parser.add_argument(
        "--prior",
        metavar="TOPIC",
        action="append",
        help="PoseStamped, PoseWithCovarianceStamped or Odometry; may be given several times",
    )
    parser.add_argument("--initialpose", metavar="TOPIC", help="geometry_msgs/PoseWithCovarianceStamped, of the base")
    parser.add_argument("--odom", metavar="TOPIC", help="nav_msgs/Odometry, with -p track:=true")
    parser.add_argument("--tf", metavar="TOPIC", default="/tf", help="if it is there (default: %(default)s)")
    parser.add_argument("--tf-static", metavar="TOPIC", default="/tf_static", help="the same (default: %(default)s)")
    parser.add_argument("--params-file", type=Path, metavar="FILE", help="parameters of the node")
    add_node_parameters(parser, "one of these; what is set by an option of its own comes last")
    parser.add_argument(
        "--truth",
        metavar="TOPIC",
        help="the true pose of the camera: as --prior, or a nav_msgs/Odometry of the camera in the map frame",
    )
    parser.add_argument(
        "--prior-max-age",
        type=number(float, 0),
        metavar="SECONDS",
        help="for which a prior holds as it is; it may be newer than an image by no more; 0 for no limit (default: "
        f"{PriorPolicy().max_age:g})",
    )
    parser.add_argument("--rectified", action="store_true", help="the images are rectified, as image.rectified")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="a new or empty folder")
    parser.add_argument("--matcher", choices=sorted(MATCHERS), help=f"default: {matcher.name}")
    parser.add_argument("--weights", metavar="PATH", help="of a learned matcher, as matcher.weights")
    parser.add_argument("--seed", type=number(int, 0), help="of RANSAC and of the search")
    parser.add_argument(
        "--max-width",
        type=number(int, 1),
        help=f"resize wider images (default: {localizer.max_image_width})",
    )
    parser.add_argument(
        "--set",
        type=setting(lambda parse_number: parse_number),
        default={},
        action=CollectSettings,
        metavar="OPTION=VALUE",
        help=f"change an option of the localizer: {', '.join(localizer_options())}",
    )
    add_map_options(parser)
    return parser


if __name__ == "__main__":
    sys.exit(main())
