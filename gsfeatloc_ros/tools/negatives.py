"""Show a localizer photos that are not of its map, and count the answers: each of them is wrong.

    python -m gsfeatloc_ros.tools.negatives SCENE SCENE --matcher sift,xfeat

In the map of every scene it looks for the scene's own photos mirrored and upside down, for the photos of the other
scenes, for noise and for black.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median

from tqdm import tqdm

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.evaluate.metrics import finite_or_none
from gsfeatloc_ros.evaluate.negatives import Stranger, draw_strangers
from gsfeatloc_ros.evaluate.scene import load_scene
from gsfeatloc_ros.localize.estimate import Status
from gsfeatloc_ros.localize.localizer import Localizer, LocalizerOptions
from gsfeatloc_ros.maps import load_map
from gsfeatloc_ros.match import DEFAULT_MATCHER, MATCHERS, create_matcher
from gsfeatloc_ros.render import DrawOptions, create_renderer


@dataclass(frozen=True)
class Answer:
    """What the localizer made of a photo that is not of the scene."""

    scene: str
    matcher: str
    kind: str
    photo: str
    status: str
    reason: str
    inliers: int
    inlier_ratio: float | None
    coverage: float
    agreement: float | None
    cpu_seconds: float


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status: 0 if no photo was given a pose."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, nargs="+", help="folder as for evaluate")
    parser.add_argument("--matcher", default=DEFAULT_MATCHER, help=f"of {', '.join(MATCHERS)}, or several")
    parser.add_argument("--sigma", type=float, default=1.0, help="scale of the priors' errors (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the priors (default: %(default)s)")
    parser.add_argument("--limit", type=int, default=0, help="only the first photos of each scene; 0 for all")
    parser.add_argument("--json", type=Path, help="write the answers to this file")
    options = parser.parse_args(arguments)
    matchers = options.matcher.split(",")
    if unknown := [name for name in matchers if name not in MATCHERS]:
        parser.error(f"--matcher: {', '.join(unknown)} is not one of {', '.join(MATCHERS)}")
    try:
        answers = [answer for matcher in matchers for answer in _ask(options, matcher)]
        if options.json:
            options.json.write_text(json.dumps([asdict(answer) for answer in answers], indent=2) + "\n")
    except (ValueError, RuntimeError, OSError) as error:  # a scene, map, weights or file that cannot be used
        print(f"strangers: {error}", file=sys.stderr)
        return 1
    _print_table(answers)
    return 2 if any(answer.status == Status.LOCALIZED.value for answer in answers) else 0


def _ask(options: argparse.Namespace, matcher_name: str) -> list[Answer]:
    """Look for strangers in all scenes with one matcher."""
    matcher = create_matcher(matcher_name)
    scenes = [load_scene(folder) for folder in options.scene]
    answers = []
    for scene in scenes:
        renderer = create_renderer(load_map(scene.map_path), options=DrawOptions(scene.background))
        localizer = Localizer(renderer, matcher, LocalizerOptions(seed=options.seed))
        others = [other for other in scenes if other is not scene]
        strangers = draw_strangers(scene, others, options.sigma, options.seed, options.limit)
        for stranger in tqdm(strangers, desc=f"{matcher_name} {scene.name}", unit="photo"):
            answers.append(
                _localize(localizer, scene.photos[stranger.photo].camera, stranger, scene.name, matcher_name)
            )
    return answers


def _localize(localizer: Localizer, camera: Camera, stranger: Stranger, scene: str, matcher: str) -> Answer:
    start = time.process_time()
    prior = stranger.prior
    estimate = localizer.localize(stranger.image, camera, prior.T_map_camera, prior.covariance)
    return Answer(
        scene=scene,
        matcher=matcher,
        kind=stranger.kind,
        photo=stranger.name,
        status=estimate.status.value,
        reason=estimate.reason,
        inliers=estimate.inliers,
        inlier_ratio=finite_or_none(estimate.inlier_ratio),
        coverage=estimate.coverage,
        agreement=finite_or_none(estimate.agreement),
        cpu_seconds=round(time.process_time() - start, 3),
    )


def _print_table(answers: Sequence[Answer]) -> None:
    """A line for every matcher, scene and kind of photo."""
    print("matcher            scene      photos of    photos accepted rejected failed  CPU-s")
    groups: dict[tuple[str, str, str], list[Answer]] = {}
    for answer in answers:
        groups.setdefault((answer.matcher, answer.scene, answer.kind), []).append(answer)
    for (matcher, scene, kind), group in groups.items():
        accepted, rejected, failed = (sum(a.status == status.value for a in group) for status in Status)
        seconds = median(answer.cpu_seconds for answer in group)
        print(f"{matcher:18} {scene:10} {kind:12} {len(group):6} {accepted:8} {rejected:8} {failed:6}  {seconds:.2f}")
    total = sum(answer.status == Status.LOCALIZED.value for answer in answers)
    print(f"accepted {total} of {len(answers)}")


if __name__ == "__main__":
    sys.exit(main())
