"""Localize the images of a recorded bag, without a ROS graph, as the node would.

    python -m gsfeatloc_ros.tools.replay BAG --map room.ply --image /camera/image_raw \\
        --camera-info /camera/camera_info --prior /prior --truth /ground_truth --out replayed

BAG is a rosbag2: its folder, or an .mcap or .db3 file. Into the folder of --out go answers.tum, answers.csv (a line for
each image), the bag `answers` (geometry_msgs/PoseWithCovarianceStamped on /pose), and with --truth errors.png.

An image is localized with the camera_info and the prior that were recorded last before it. The truth is compared at the
stamp of the image, between two poses that are not more than 0.25 s apart.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from statistics import median

from tqdm import tqdm

from gsfeatloc_ros.common.parameter import settings_from
from gsfeatloc_ros.evaluate.extras import import_extra
from gsfeatloc_ros.localize.engine import Engine, load_matcher, load_renderer
from gsfeatloc_ros.localize.localizer import Localizer
from gsfeatloc_ros.localize.options import LocalizerOptions
from gsfeatloc_ros.localize.settings import MatcherSettings, RendererSettings
from gsfeatloc_ros.match import MATCHERS
from gsfeatloc_ros.replay.bag import Bag, BagError, Role, open_bag
from gsfeatloc_ros.replay.figure import write_figure
from gsfeatloc_ros.replay.output import errors, write_bag, write_csv, write_tum
from gsfeatloc_ros.replay.run import Replay, ReplayedImage
from gsfeatloc_ros.replay.truth import Trajectory
from gsfeatloc_ros.ros_io.outcome import OutcomeStatus
from gsfeatloc_ros.ros_io.prior import PriorPolicy
from gsfeatloc_ros.tools.options import (
    CollectSettings,
    add_map_options,
    localizer_options,
    map_settings,
    number,
    print_reading,
    setting,
)

# Reasons of a kind in the summary, of which there may be as many as images.
_MAX_REASONS = 5


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status.

    It is 0 when all images were tried, 1 when something cannot be used and 130 when the user interrupted it. What came
    before a damage of the bag or an interruption is written.
    """
    options = _parser().parse_args(arguments)
    try:
        return _replay(options)
    except (ValueError, RuntimeError, OSError) as error:  # a bag, map, weights or folder that cannot be used
        print(f"replay: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("replay: interrupted", file=sys.stderr)
        return 130


def _replay(options: argparse.Namespace) -> int:
    if options.out.exists() and (not options.out.is_dir() or any(options.out.iterdir())):
        raise ValueError(f"{options.out}: is there already: name a new or an empty folder")
    topics = {Role.IMAGE: options.image, Role.CAMERA_INFO: options.camera_info, Role.PRIOR: options.prior}
    if options.truth:
        topics[Role.TRUTH] = options.truth
        import_extra("matplotlib")  # to say now, not after an hour, that it is missing
    policy = PriorPolicy(map_frame=options.map_frame, max_age=options.prior_max_age)
    with open_bag(options.bag, topics) as bag:
        replay = Replay(bag, _localizer(options), policy, options.rectified)
        options.out.mkdir(parents=True, exist_ok=True)
        start = time.monotonic()
        images, status = _collect(replay, bag.images)
        seconds = time.monotonic() - start
    truth = Trajectory(replay.truth) if options.truth else None
    write_tum(options.out / "answers.tum", images)
    write_csv(options.out / "answers.csv", images, truth)
    write_bag(options.out / "answers", bag.storage, images, options.map_frame)
    if truth is not None:
        write_figure(options.out / "errors.png", images, truth, options.map_frame)
    print(_summary(bag, replay, images, truth, seconds))
    print(f"wrote {options.out}")
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
        print(f"replay: {error}", file=sys.stderr)
        return images, 1
    except KeyboardInterrupt:
        print("replay: interrupted", file=sys.stderr)
        return images, 130
    return images, 0


def _localizer(options: argparse.Namespace) -> Localizer:
    map_ = map_settings(options)
    renderer = load_renderer(map_, RendererSettings())
    print_reading("replay", renderer)
    matcher = load_matcher(MatcherSettings(options.matcher, options.weights), renderer.device)
    values = {"max_image_width": options.max_width, "seed": options.seed, **options.set}
    return Engine(map_.path, renderer, matcher, settings_from(LocalizerOptions, values)).localizer


def _summary(
    bag: Bag, replay: Replay, images: Sequence[ReplayedImage], truth: Trajectory | None, seconds: float
) -> str:
    """Return what came out, for the terminal."""
    outcomes = [image.outcome for image in images]
    counts = Counter(outcome.status for outcome in outcomes)
    localized = counts.pop(OutcomeStatus.LOCALIZED, 0)
    lines = [f"localized {localized} of {len(images)} images"]
    if len(images) < bag.images:
        lines[0] += f"; the bag has {bag.images}"
    elif bag.seconds:
        lines[0] += f"; {bag.seconds:.1f} s of recording in {seconds:.1f} s"
    times = [outcome.estimate.milliseconds["total"] for outcome in outcomes if outcome.estimate is not None]
    if times:
        lines.append(f"  median {median(times):.0f} ms an image")
    for status in sorted(counts, key=lambda status: status.value):
        lines.append(f"  {counts[status]} {status.value}:")
        lines += _reasons(Counter(outcome.reason for outcome in outcomes if outcome.status is status))
    for role in sorted({role for role, _ in replay.unusable}, key=lambda role: role.value):
        lines.append(f"  {role.value} messages that cannot be used:")
        lines += _reasons(Counter({why: count for (of, why), count in replay.unusable.items() if of is role}))
    if truth is not None:
        known = [errors(image, truth) for image in images if image.pose is not None]
        pairs = [(e["rotation_error_deg"], e["translation_error"]) for e in known if e]
        lines.append(f"  truth known for {len(pairs)} of the {localized} answers")
        if pairs:
            rotation, translation = zip(*pairs, strict=True)
            lines[-1] += (
                f": median error {median(rotation):.3f} degrees, {median(translation):.4f} map units; largest "
                f"{max(rotation):.3f} degrees, {max(translation):.4f}"
            )
    return "\n".join(lines)


def _reasons(counts: Counter[str]) -> list[str]:
    lines = [f"    {count} x {reason}" for reason, count in counts.most_common(_MAX_REASONS)]
    return lines + (["    ..."] if len(counts) > _MAX_REASONS else [])


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="replay", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    matcher, localizer = MatcherSettings(), LocalizerOptions()
    parser.add_argument("bag", type=Path, help="folder of a rosbag2, or an .mcap or .db3 file")
    parser.add_argument("--map", type=Path, required=True, help="the Gaussian Splatting map")
    for option, types in (
        ("--image", "sensor_msgs/Image or CompressedImage"),
        ("--camera-info", "sensor_msgs/CameraInfo"),
        ("--prior", "geometry_msgs/PoseStamped or PoseWithCovarianceStamped"),
    ):
        parser.add_argument(option, metavar="TOPIC", required=True, help=types)
    parser.add_argument(
        "--truth",
        metavar="TOPIC",
        help="the true pose of the camera: as --prior, or a nav_msgs/Odometry of the camera in the map frame",
    )
    parser.add_argument(
        "--prior-max-age",
        type=number(float, 0),
        default=PriorPolicy().max_age,
        metavar="SECONDS",
        help="for which a prior holds as it is; it may be newer than an image by no more; 0 for no limit (default: "
        "%(default)s)",
    )
    parser.add_argument("--rectified", action="store_true", help="the images are rectified, as image.rectified")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="a new or empty folder")
    parser.add_argument("--matcher", choices=sorted(MATCHERS), default=matcher.name, help="default: %(default)s")
    parser.add_argument("--weights", default="", metavar="PATH", help="of a learned matcher, as matcher.weights")
    parser.add_argument("--seed", type=number(int, 0), default=localizer.seed, help="of RANSAC and of the search")
    parser.add_argument(
        "--max-width",
        type=number(int, 1),
        default=localizer.max_image_width,
        help="resize wider images (default: %(default)s)",
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
