"""Localizes the images of a recorded bag, without a ROS graph, as the node would.

    python -m gsfeatloc_ros.tools.replay BAG --map room.ply --image /camera/image_raw \\
        --camera-info /camera/camera_info --prior /prior --truth /ground_truth --out replayed

BAG is a rosbag2: its folder, or an .mcap or .db3 file. Into the folder of --out go answers.tum, answers.csv (a line for
each image), the bag `answers` (geometry_msgs/PoseWithCovarianceStamped on /pose), and with --truth errors.png.

An image is localized with the camera_info and the prior that were recorded last before it. The truth is compared at the
stamp of the image, between two poses that are not more than 0.25 s apart.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from statistics import median

from tqdm import tqdm

from gsfeatloc_ros.common.geometry import matrix_from_quaternion
from gsfeatloc_ros.evaluate.extras import import_extra
from gsfeatloc_ros.localize.localizer import Localizer, LocalizerOptions
from gsfeatloc_ros.maps import Similarity, read_dataparser_transforms
from gsfeatloc_ros.match import DEFAULT_MATCHER, MATCHERS, create_matcher
from gsfeatloc_ros.render import create_renderer
from gsfeatloc_ros.render.cache import load_prepared
from gsfeatloc_ros.replay.bag import Bag, BagError, open_bag
from gsfeatloc_ros.replay.figure import write_figure
from gsfeatloc_ros.replay.output import errors, write_bag, write_csv, write_tum
from gsfeatloc_ros.replay.run import Answer, Replay
from gsfeatloc_ros.replay.truth import Trajectory
from gsfeatloc_ros.ros_io.inputs import PriorPolicy
from gsfeatloc_ros.tools.options import Settings, localizer_options, number, setting

# Reasons in the summary, of which there may be as many as images.
_MOST_REASONS = 5


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
    topics = {"image": options.image, "camera_info": options.camera_info, "prior": options.prior}
    if options.truth:
        topics["truth"] = options.truth
        import_extra("matplotlib")  # to say now, not after an hour, that it is missing
    policy = PriorPolicy(map_frame=options.map_frame, max_age=options.prior_max_age)
    with open_bag(options.bag, topics) as bag:
        replay = Replay(bag, _localizer(options), policy, options.rectified)
        options.out.mkdir(parents=True, exist_ok=True)
        start = time.monotonic()
        answers, status = _collect(replay, bag.images)
        seconds = time.monotonic() - start
    truth = Trajectory(replay.truth) if options.truth else None
    write_tum(options.out / "answers.tum", answers)
    write_csv(options.out / "answers.csv", answers, truth)
    write_bag(options.out / "answers", bag.storage, answers, options.map_frame)
    if truth is not None:
        write_figure(options.out / "errors.png", answers, truth, options.map_frame)
    print(_summary(bag, replay, answers, truth, seconds))
    print(f"wrote {options.out}")
    return status


def _collect(replay: Replay, images: int) -> tuple[list[Answer], int]:
    """All answers and 0, or those up to where it ended too early and the exit status for that."""
    answers, localized = [], 0
    try:
        with tqdm(replay.answers(), total=images, unit="image") as progress:
            for answer in progress:
                answers.append(answer)
                localized += answer.localized
                progress.set_postfix_str(f"{localized} localized", refresh=False)
    except BagError as error:
        print(f"replay: {error}", file=sys.stderr)
        return answers, 1
    except KeyboardInterrupt:
        print("replay: interrupted", file=sys.stderr)
        return answers, 130
    return answers, 0


def _localizer(options: argparse.Namespace) -> Localizer:
    gaussian_map = load_prepared(options.map, _alignment(options))
    matcher = create_matcher(options.matcher, options.weights)
    settings = LocalizerOptions(max_image_width=options.max_width, seed=options.seed, **options.set)
    return Localizer(create_renderer(gaussian_map), matcher, settings)


def _alignment(options: argparse.Namespace) -> Similarity:
    rotation = matrix_from_quaternion(options.map_rotation)
    alignment = Similarity(options.map_scale, rotation, options.map_translation)
    if options.dataparser_transforms is None:
        return alignment
    return alignment @ read_dataparser_transforms(options.dataparser_transforms)


def _summary(bag: Bag, replay: Replay, answers: Sequence[Answer], truth: Trajectory | None, seconds: float) -> str:
    """What came out, for the terminal."""
    counts = Counter(answer.status for answer in answers)
    lines = [f"localized {counts['localized']} of {len(answers)} images"]
    if len(answers) < bag.images:
        lines[0] += f"; the bag has {bag.images}"
    elif bag.seconds:
        lines[0] += f"; {bag.seconds:.1f} s of recording in {seconds:.1f} s"
    times = [answer.estimate.milliseconds["total"] for answer in answers if answer.estimate]
    if times:
        lines.append(f"  median {median(times):.0f} ms an image")
    for status in sorted(counts.keys() - {"localized"}):
        lines.append(f"  {counts[status]} {status}:")
        lines += _reasons(Counter(answer.reason for answer in answers if answer.status == status))
    for role in sorted({role for role, _ in replay.unusable}):
        lines.append(f"  {role} messages that cannot be used:")
        lines += _reasons(Counter({why: count for (of, why), count in replay.unusable.items() if of == role}))
    if truth is not None:
        known = [errors(answer, truth) for answer in answers if answer.localized]
        known = [(e["rotation_error_deg"], e["translation_error"]) for e in known if e]
        lines.append(f"  truth known for {len(known)} of the {counts['localized']} answers")
        if known:
            rotation, translation = zip(*known, strict=True)
            lines[-1] += (
                f": median error {median(rotation):.3f} degrees, {median(translation):.4f} map units; largest "
                f"{max(rotation):.3f} degrees, {max(translation):.4f}"
            )
    return "\n".join(lines)


def _reasons(counts: Counter[str]) -> list[str]:
    lines = [f"    {count} x {reason}" for reason, count in counts.most_common(_MOST_REASONS)]
    return lines + (["    ..."] if len(counts) > _MOST_REASONS else [])


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="replay", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("bag", type=Path, help="folder of a rosbag2, or an .mcap or .db3 file")
    parser.add_argument("--map", type=Path, required=True, help="the Gaussian Splatting map")
    topic = {"metavar": "TOPIC", "required": True}
    parser.add_argument("--image", **topic, help="sensor_msgs/Image or CompressedImage")
    parser.add_argument("--camera-info", **topic, help="sensor_msgs/CameraInfo")
    parser.add_argument("--prior", **topic, help="geometry_msgs/PoseStamped or PoseWithCovarianceStamped")
    parser.add_argument(
        "--truth",
        metavar="TOPIC",
        help="the true pose of the camera: as --prior, or a nav_msgs/Odometry of the camera in the map frame",
    )
    parser.add_argument(
        "--prior-max-age",
        type=number(float, 0),
        default=PriorPolicy.max_age,
        metavar="SECONDS",
        help="by which a prior may be older or newer than an image; 0 for no limit (default: %(default)s)",
    )
    parser.add_argument("--rectified", action="store_true", help="the images are rectified, as image.rectified")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="a new or empty folder")
    parser.add_argument("--matcher", choices=sorted(MATCHERS), default=DEFAULT_MATCHER, help="default: %(default)s")
    parser.add_argument("--weights", default="", metavar="PATH", help="of a learned matcher, as matcher.weights")
    parser.add_argument("--seed", type=number(int, 0), default=0, help="of RANSAC and of the search")
    parser.add_argument(
        "--max-width", type=number(int, 1), default=640, help="resize wider images (default: %(default)s)"
    )
    parser.add_argument(
        "--set",
        type=setting(lambda parse_number: parse_number),
        default={},
        action=Settings,
        metavar="OPTION=VALUE",
        help=f"change an option of the localizer: {', '.join(localizer_options())}",
    )
    finite = number(float, -math.inf)
    frame = parser.add_argument_group("the map's frame", "as the node's parameters map.*")
    frame.add_argument("--map-frame", default="map", metavar="NAME", help="default: %(default)s")
    frame.add_argument("--map-scale", type=finite, default=1.0, metavar="S", help="default: %(default)s")
    frame.add_argument("--map-translation", type=finite, nargs=3, default=[0.0] * 3, metavar=("X", "Y", "Z"))
    frame.add_argument("--map-rotation", type=finite, nargs=4, default=[0.0] * 3 + [1.0], metavar=("X", "Y", "Z", "W"))
    frame.add_argument("--dataparser-transforms", type=Path, metavar="FILE", help="nerfstudio's")
    return parser


if __name__ == "__main__":
    sys.exit(main())
