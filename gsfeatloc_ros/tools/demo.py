"""Localize a camera in a simulated room, from start to end over ROS.

Builds a room, its Gaussian Splatting map and a bag of photos with rough priors, starts the installed `localizer`, plays
the bag into it, and compares its answers with the truth. Then the camera is kidnapped: some photos come without a prior
from anywhere in the room. Exits with 0 when at least 95 % of the photos with priors, and all without, are localized
within 1 degree and 2 cm.

    gsfeatloc demo --matcher xfeat --photos 40
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np

from gsfeatloc_ros.client.bag_player import Reply, Topics, play_bag, play_lost
from gsfeatloc_ros.client.process import INDEX_READY, isolate_ros, running_localizer
from gsfeatloc_ros.client.score import MAX_ROTATION_ERROR_DEG, MAX_TRANSLATION_ERROR, Score, draw_scores, score
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.maps.ply import write_ply
from gsfeatloc_ros.match import DEFAULT_MATCHER, MATCHERS
from gsfeatloc_ros.render import create_renderer
from gsfeatloc_ros.simulate import Room, SimulatedPhoto, cover, simulate_photos, write_bag
from gsfeatloc_ros.simulate.bag import CAMERA_INFO_TOPIC, IMAGE_TOPIC, PRIOR_TOPIC
from gsfeatloc_ros.tools.options import add_old_name, number
from gsfeatloc_ros.tools.status import run_tool

MIN_SUCCESS_RATE = 0.95
# The localizer's own names of the topics are remapped to those of the bag.
TOPICS = Topics(IMAGE_TOPIC, CAMERA_INFO_TOPIC, PRIOR_TOPIC)

# A camera of 65 degrees with the barrel distortion of a cheap lens.
_K = [[500.0, 0.0, 322.0], [0.0, 502.0, 236.0], [0.0, 0.0, 1.0]]
_CAMERA = Camera(640, 480, np.array(_K), np.array([-0.28, 0.09, 0.0008, -0.0005, 0.0]))
_VIEWS = 120
_PICTURE_ROWS = 4
_KIDNAPPINGS = 5
# Seconds until the map's views are known: half a minute, or many on cores that others use.
_INDEX_TIMEOUT = 900.0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the demo; return the exit status: 1 where it did not go well, 2 where something cannot be used."""
    args = make_parser().parse_args(argv)
    return run_tool("demo", lambda: _demo(args))


def _demo(args: argparse.Namespace) -> int:
    args.out.mkdir(parents=True, exist_ok=True)
    room = Room()
    room_map = cover(room)
    map_file, bag, log = args.out / "room.ply", args.out / "bag", args.out / "localizer.log"
    write_ply(map_file, room_map)
    print(f"map: {len(room_map)} Gaussians cover the room, in {map_file}", flush=True)
    photos = simulate_photos(room, _CAMERA, args.photos)
    shutil.rmtree(bag, ignore_errors=True)
    write_bag(bag, _CAMERA, photos)
    print(f"bag: {len(photos)} photos with priors, in {bag}", flush=True)

    isolate_ros()
    # A room needs few views, and the user is waiting.
    parameters = {"map.path": map_file.resolve(), "matcher.name": args.matcher, "index.views": _VIEWS}
    try:
        with running_localizer(parameters, TOPICS.remappings, log) as localizer:
            print(f"localizer: started with {args.matcher}, its log in {log}", flush=True)
            localizer.wait_for_output(INDEX_READY, _INDEX_TIMEOUT)
            print("localizer: knows what the room looks like from anywhere\n", flush=True)
            scores = _play(photos, play_bag(bag, TOPICS, lambda: localizer.alive))
            print("\nkidnapped: it is told that it is lost, and sees another place without a prior", flush=True)
            places = range(0, len(photos), -(-len(photos) // _KIDNAPPINGS))
            lost = _play([photos[i] for i in places], play_lost(bag, TOPICS, places, lambda: localizer.alive))
    except (RuntimeError, TimeoutError) as error:
        print(f"demo: {error}; see {log}", file=sys.stderr)
        return 1

    picture = args.out / "photos.png"
    cv2.imwrite(str(picture), draw_scores(scores, _CAMERA, create_renderer(room_map), _PICTURE_ROWS)[:, :, ::-1])
    print(f"\nphoto | render at the prior | render at the estimate: {picture}")
    print(summary(scores))
    print(f"without a prior: {summary(lost)}")
    found = sum(each.success for each in scores) >= MIN_SUCCESS_RATE * len(scores)
    return 0 if found and all(each.success for each in lost) else 1


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog="gsfeatloc demo", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("demo_output"), help="folder of the results (%(default)s)")
    photos = parser.add_argument("--photos", type=number(int, 1), default=40, help="number of photos (%(default)s)")
    add_old_name(parser, photos, "--queries")
    parser.add_argument(
        "--matcher", choices=sorted(MATCHERS), default=DEFAULT_MATCHER, help="of features (%(default)s)"
    )
    return parser


def _play(photos: Sequence[SimulatedPhoto], replies: Iterable[Reply]) -> list[Score]:
    """Print a line for the reply to each photo."""
    print("photo         prior error          final error   inliers      ms", flush=True)
    scores = []
    for photo, reply in zip(photos, replies, strict=True):
        scores.append(score(photo, reply))
        print(row(len(scores), scores[-1]), flush=True)
    return scores


def row(number: int, score: Score) -> str:
    """Return the line of the table for a photo."""
    prior = f"{number:5d}   {score.prior_error[0]:5.1f} deg {score.prior_error[1]:5.2f} m"
    if score.reply.T_map_camera is None:
        return f"{prior}   no answer: {score.reply.evidence.get('reason', 'none came in time')}"
    final = f"{score.error[0]:6.3f} deg {100 * score.error[1]:6.2f} cm"
    return f"{prior}   {final}   {score.reply.evidence['inliers']:>7}   {score.reply.milliseconds:5.0f}"


def summary(scores: Sequence[Score]) -> str:
    """Return the last line: how many photos were localized, and how well."""
    successes = sum(score.success for score in scores)
    counted = (
        f"localized {successes} of {len(scores)} ({100 * successes / len(scores):.0f} %) "
        f"within {MAX_ROTATION_ERROR_DEG:g} degree and {100 * MAX_TRANSLATION_ERROR:g} cm"
    )
    answered = [(*score.error, score.reply.milliseconds) for score in scores if score.reply.T_map_camera is not None]
    if not answered:
        return f"{counted}; no answers"
    degrees, metres, milliseconds = np.median(answered, axis=0)
    return f"{counted}; median error {degrees:.2f} degrees, {100 * metres:.1f} cm; median {milliseconds:.0f} ms"


if __name__ == "__main__":
    sys.exit(main())
