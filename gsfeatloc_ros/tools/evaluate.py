"""Localizes the test photos of a scene from wrong priors and says how well.

    python -m gsfeatloc_ros.tools.evaluate SCENE --method default --matcher xfeat --json result.json

SCENE is a folder with map.ply, transforms.json (nerfstudio) and the photos. A query that was not answered has the
errors of its prior.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path

from tqdm import tqdm

from gsfeatloc_ros.evaluate.metrics import MAX_ROTATION_ERROR_DEG, MAX_TRANSLATION_ERROR, QueryResult, summarize
from gsfeatloc_ros.evaluate.protocol import PROTOCOLS, make_priors
from gsfeatloc_ros.evaluate.run import METHODS, create_localizer, localize_photos
from gsfeatloc_ros.evaluate.scene import load_scene
from gsfeatloc_ros.maps import load_map
from gsfeatloc_ros.match import MATCHERS, create_matcher
from gsfeatloc_ros.render import create_renderer


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status: 0 when all photos were tried, 1 when something cannot be used."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.json and not options.json.parent.is_dir():
        parser.error(f"--json {options.json}: there is no folder {options.json.parent}")
    try:
        report = _evaluate(options)
        if options.json:
            options.json.write_text(json.dumps(report, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    except (ValueError, RuntimeError, OSError) as error:  # a scene, map, weights or file that cannot be used
        print(f"evaluate: {error}", file=sys.stderr)
        return 1
    return 0


def _evaluate(options: argparse.Namespace) -> dict:
    scene = load_scene(options.scene)
    priors = make_priors(scene, PROTOCOLS[options.protocol](scene, options.sigma), options.seed)
    priors = priors[: options.limit or None]
    renderer = create_renderer(load_map(scene.map_path), background=scene.background)
    localizer = create_localizer(
        options.method, renderer, create_matcher(options.matcher), options.max_width, options.seed
    )
    queries = localize_photos(scene, localizer, priors)
    results = list(
        tqdm(queries, total=len(priors), desc=f"{scene.name} {options.method} {options.matcher}", unit="photo")
    )
    report = {
        "scene": scene.name,
        "protocol": options.protocol,
        "method": options.method,
        "matcher": options.matcher,
        "sigma": options.sigma,
        "seed": options.seed,
        **summarize(results),
    }
    print(_table(results))
    print(_summary(report))
    return report


def _table(results: list[QueryResult]) -> str:
    """One line a query."""
    width = max(len(result.photo) for result in results)
    lines = [f"{'photo':{width}}     prior error      final error   matches  inliers     ms"]
    for result in results:
        line = (
            f"{result.photo:{width}}  {result.prior_rotation_error_deg:5.1f} deg {result.prior_translation_error:5.3f}"
            f"  {result.rotation_error_deg:6.3f} deg {result.translation_error:6.4f}"
            f"  {result.matches:7}  {result.inliers:7}  {result.milliseconds:5.0f}"
        )
        if not result.answered:
            line += f"  NOT ANSWERED: {result.reason}"
        elif not result.success:
            line += "  WRONG"
        lines.append(line)
    return "\n".join(lines)


def _summary(report: dict) -> str:
    rotation, translation, time = (report[key] for key in ("rotation_error_deg", "translation_error", "milliseconds"))
    return (
        f"\n{report['scene']}, protocol {report['protocol']} (sigma {report['sigma']:g}, seed {report['seed']}), "
        f"method {report['method']}, matcher {report['matcher']}\n"
        f"  success            {100 * report['success_rate']:.1f} % of {report['queries']} "
        f"(< {MAX_ROTATION_ERROR_DEG:g} deg and < {MAX_TRANSLATION_ERROR:g} of the trajectory's radius)\n"
        f"  answered           {report['answered']}, of which wrong {report['wrong_answers']}\n"
        f"  rotation error     median {rotation['median']:.3f} deg, mean {rotation['mean']:.3f} deg\n"
        f"  translation error  median {translation['median']:.4f}, mean {translation['mean']:.4f} (over the radius)\n"
        f"  time per photo     median {time['median']:.0f} ms, 95 % within {time['p95']:.0f} ms\n"
        "  (a photo that was not answered has the errors of its prior)"
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="evaluate", description="Localize the test photos of a scene from wrong priors."
    )
    parser.add_argument("scene", type=Path, help="folder with map.ply, transforms.json and the test photos")
    parser.add_argument("--protocol", choices=list(PROTOCOLS), default="paper", help="how priors are made wrong")
    parser.add_argument("--method", choices=METHODS, default="default", help="this package's, or the published recipe")
    parser.add_argument(
        "--matcher", choices=list(MATCHERS), default="xfeat", help="local features (default: %(default)s)"
    )
    parser.add_argument("--sigma", type=_number(float, 0), default=1.0, help="scale of the priors' errors")
    parser.add_argument("--seed", type=_number(int, 0), default=0, help="seed of the priors and of RANSAC")
    parser.add_argument("--limit", type=_number(int, 0), default=0, help="only the first photos; 0 for all")
    parser.add_argument(
        "--max-width", type=_number(int, 1), default=640, help="resize wider photos (default: %(default)s)"
    )
    parser.add_argument("--json", type=Path, help="write the report to this file")
    return parser


def _number(kind: Callable[[str], float], minimum: float) -> Callable[[str], float]:
    def parse(text: str) -> float:
        value = kind(text)
        if not (math.isfinite(value) and value >= minimum):
            raise argparse.ArgumentTypeError(f"{text} is not a number of at least {minimum}")
        return value

    return parse


if __name__ == "__main__":
    sys.exit(main())
