"""Show a localizer photos that are not of its map, and count the answers: each of them is wrong.

    gsfeatloc negatives SCENE SCENE --matcher sift,xfeat

In the map of every scene it looks for the scene's own photos mirrored and upside down, for the photos of the other
scenes, for noise and for black.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

from gsfeatloc_ros.evaluate.negatives import NegativeOptions, NegativeResult, localize_negatives, negative_table
from gsfeatloc_ros.evaluate.scene import load_scene
from gsfeatloc_ros.match import DEFAULT_MATCHER, MATCHERS
from gsfeatloc_ros.tools.options import check_outputs, number
from gsfeatloc_ros.tools.status import run_tool


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status: 0 if no photo was given a pose, 1 if one was, 2 for an error."""
    parser = make_parser()
    options = parser.parse_args(arguments)
    matchers = options.matcher.split(",")
    if unknown := [name for name in matchers if name not in MATCHERS]:
        parser.error(f"--matcher: {', '.join(unknown)} is not one of {', '.join(MATCHERS)}")
    return run_tool("negatives", lambda: _negatives(options, matchers))


def _negatives(options: argparse.Namespace, matchers: Sequence[str]) -> int:
    check_outputs(options.json)
    results = _localize(options, matchers)
    if options.json:
        rows = [result.row() for result in results]
        options.json.write_text(json.dumps(rows, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    print(negative_table(results))
    return 1 if any(result.estimate.localized for result in results) else 0


def _localize(options: argparse.Namespace, matchers: Sequence[str]) -> list[NegativeResult]:
    """Localize all negatives, with a bar that shows how far it is."""
    scenes = [load_scene(folder) for folder in options.scene]
    drawn = NegativeOptions(options.sigma, options.seed, options.limit, options.no_prior)
    results = []
    with tqdm(localize_negatives(scenes, matchers, drawn), unit="photo") as progress:
        for result in progress:
            results.append(result)
            progress.set_description(f"{result.matcher} {result.scene}", refresh=False)
    return results


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog="gsfeatloc negatives", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", type=Path, nargs="+", help="folder as for evaluate")
    parser.add_argument("--matcher", default=DEFAULT_MATCHER, help=f"of {', '.join(MATCHERS)}, or several")
    parser.add_argument(
        "--sigma", type=number(float, 0), default=1.0, help="scale of the priors' errors (default: %(default)s)"
    )
    parser.add_argument("--seed", type=number(int, 0), default=0, help="of the priors (default: %(default)s)")
    parser.add_argument(
        "--no-prior", action="store_true", help="look for them without a prior, by an index of the map's views"
    )
    parser.add_argument(
        "--limit", type=number(int, 0), default=0, help="only the first photos of each scene; 0 for all"
    )
    parser.add_argument("--json", type=Path, help="write the answers to this file")
    return parser


if __name__ == "__main__":
    sys.exit(main())
