"""Localize the test photos of scenes from wrong priors, and say how well.

    gsfeatloc evaluate SCENE --method default --matcher xfeat --json result.json
    gsfeatloc evaluate SCENE... --method default,published --matcher sift,xfeat --seed 0-9 \\
        --jobs 4 --report report
    gsfeatloc evaluate SCENE... --suite trust --jobs 2 --report trust

SCENE is a folder with photos and their poses (nerfstudio's transforms.json, NeRF-Synthetic or a COLMAP model) and a
map. Where options name several scenes, methods, matchers, sigmas or seeds, all combinations are run. A query that was
not answered has the errors of its prior.
"""

from __future__ import annotations

import argparse
import itertools
import json
import shlex
import sys
from collections.abc import Callable, Collection
from pathlib import Path

from tqdm import tqdm

from gsfeatloc_ros.evaluate.ablation import ABLATIONS
from gsfeatloc_ros.evaluate.corruptions import CORRUPTIONS
from gsfeatloc_ros.evaluate.degradations import DEGRADATIONS
from gsfeatloc_ros.evaluate.plan import Combinations, Evaluation
from gsfeatloc_ros.evaluate.protocol import PROTOCOLS, WITHOUT_PRIOR
from gsfeatloc_ros.evaluate.record import Record
from gsfeatloc_ros.evaluate.run import INDICES, METHODS, PRIORS_FILE
from gsfeatloc_ros.evaluate.suites import SUITES, Condition
from gsfeatloc_ros.evaluate.tables import RunResults, describe, over_seeds, query_table, run_summary, run_table
from gsfeatloc_ros.evaluate.trust import describe_trust, trust_table
from gsfeatloc_ros.match import DEFAULT_MATCHER, MATCHERS
from gsfeatloc_ros.tools.options import CollectSettings, add_old_name, check_outputs, localizer_options, number, setting
from gsfeatloc_ros.tools.status import run_tool

_NOTHING = "nothing"


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status.

    It is 0 when all photos were tried, 2 when something cannot be used and 130 when the user interrupted it.
    """
    parser = make_parser()
    options = parser.parse_args(arguments)
    _check(parser, options)
    command = shlex.join(["gsfeatloc", "evaluate", *(arguments or sys.argv[1:])])
    interrupted = "interrupted; the same command goes on from here"
    return run_tool("evaluate", lambda: _evaluate_and_write(options, command), interrupted)


def _evaluate_and_write(options: argparse.Namespace, command: str) -> int:
    """Do what the options ask for; `command` is the command line that gave them."""
    check_outputs(options.json)
    results = _evaluate(options)
    if options.json:
        content = describe(results)
        if options.suite:
            content["trust"] = describe_trust(over_seeds(results))
        options.json.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    if options.report:
        from gsfeatloc_ros.evaluate.report import write_report

        print(f"evaluate: wrote {write_report(options.report, results, command)}")
    return 0


def _evaluate(options: argparse.Namespace) -> list[RunResults]:
    """Do all runs, but for what the record has already, and print what came out."""
    record = Record(_record_path(options))
    evaluation = Evaluation(_combinations(options).runs(), options.limit, record)
    done = evaluation.queries - len(evaluation.to_do)
    for note in record.notes:
        print(f"evaluate: {note}")
    if evaluation.recorded:
        print(f"evaluate: {record.path}: has {done} of the {evaluation.queries} results already")
    with tqdm(total=evaluation.queries, initial=done, unit="photo") as progress:
        for task in evaluation.localize(options.jobs):
            progress.set_description(f"{task.run.scene.name} {task.run.method} {task.run.matcher}", refresh=False)
            progress.update()
    results = evaluation.results()
    if options.suite:
        print(trust_table(over_seeds(results)))
    elif len(results) == 1:
        print(query_table(results[0].results))
        print(run_summary(describe(results)))
    else:
        print(run_table(over_seeds(results)))
    return results


def _record_path(options: argparse.Namespace) -> Path | None:
    """Return where the results are kept, each as soon as it is there."""
    if options.report:
        options.report.mkdir(parents=True, exist_ok=True)
        return options.report / "results.jsonl"
    return options.json and options.json.with_suffix(".jsonl")


def _combinations(options: argparse.Namespace) -> Combinations:
    """Return the settings that the options name."""
    none = [None] * len(options.scene)
    return Combinations(
        scenes=[
            (scene.resolve(), *(path and path.resolve() for path in paths))
            for scene, *paths in zip(
                options.scene, options.map or none, options.dataparser_transforms or none, strict=True
            )
        ],
        conditions=_conditions(options),
        priors_file=options.priors and options.priors.resolve(),
        methods=options.method,
        matchers=options.matcher,
        sigmas=options.sigma,
        seeds=options.seed,
        max_width=options.max_width,
        options=options.set,
        index=options.index,
        ablations=[name.replace(_NOTHING, "") for name in options.ablation],
    )


def _conditions(options: argparse.Namespace) -> list[Condition]:
    """Return what the options do to photos, priors and maps."""
    if options.suite:
        return list(SUITES[options.suite])
    corruptions, degradations = (
        [name.replace(_NOTHING, "") for name in names] for names in (options.corruption, options.degrade)
    )
    return [Condition(*names) for names in itertools.product(options.protocol, corruptions, degradations)]


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog="gsfeatloc evaluate",
        description="Localize the test photos of scenes from wrong priors.",
        epilog="LIST: one or several, separated by commas; numbers also as 0-9. All combinations are run.",
    )
    parser.add_argument(
        "scene",
        type=Path,
        nargs="+",
        help="folder with a map, photos and transforms.json, transforms_test.json or COLMAP's sparse",
    )
    parser.add_argument("--map", type=Path, action="append", help="map of the scene; once for each scene")
    parser.add_argument(
        "--dataparser-transforms",
        type=Path,
        action="append",
        metavar="FILE",
        help="nerfstudio's, of a map that it has trained; once for each scene",
    )
    parser.add_argument(
        "--protocol",
        type=_names((*PROTOCOLS, PRIORS_FILE)),
        default=["paper"],
        metavar="LIST",
        help=f"how priors are made wrong: {', '.join(PROTOCOLS)} or {PRIORS_FILE} (default: paper)",
    )
    parser.add_argument("--priors", type=Path, help=f"TUM or CSV file with the priors of {PRIORS_FILE}")
    parser.add_argument(
        "--method",
        type=_names(METHODS),
        default=["default"],
        metavar="LIST",
        help="default: this package's; published: the recipe of GSFeatLoc",
    )
    parser.add_argument(
        "--matcher",
        type=_names(MATCHERS),
        default=[DEFAULT_MATCHER],
        metavar="LIST",
        help=f"local features: {', '.join(MATCHERS)} (default: {DEFAULT_MATCHER})",
    )
    parser.add_argument(
        "--sigma", type=_list(number(float, 0)), default=[1.0], metavar="LIST", help="scales of the priors' errors"
    )
    parser.add_argument(
        "--seed",
        type=_list(number(int, 0)),
        default=[0],
        metavar="LIST",
        help="seeds of the priors, of RANSAC and of the places of the index's views",
    )
    parser.add_argument(
        "--set",
        type=setting(_list),
        default={},
        action=CollectSettings,
        metavar="OPTION=LIST",
        help=f"change an option of method default: {', '.join(localizer_options())}",
    )
    ablation = parser.add_argument(
        "--ablation",
        type=_names((_NOTHING, *ABLATIONS)),
        default=[_NOTHING],
        metavar="LIST",
        help=f"take a part out of method default, one at a time: {', '.join(ABLATIONS)} (default: {_NOTHING})",
    )
    add_old_name(parser, ablation, "--without")
    corruption = parser.add_argument(
        "--corruption",
        type=_names((_NOTHING, *CORRUPTIONS)),
        default=[_NOTHING],
        metavar="LIST",
        help=f"make the photos worse, one way at a time: {', '.join(CORRUPTIONS)} (default: {_NOTHING})",
    )
    add_old_name(parser, corruption, "--spoil")
    parser.add_argument(
        "--degrade",
        type=_names((_NOTHING, *DEGRADATIONS)),
        default=[_NOTHING],
        metavar="LIST",
        help=f"make the map worse, one way at a time: {', '.join(DEGRADATIONS)} (default: {_NOTHING})",
    )
    parser.add_argument(
        "--suite",
        choices=SUITES,
        help="trust: right photos, all corruptions, degraded maps, and photos that are not of the scene",
    )
    parser.add_argument(
        "--index",
        choices=INDICES,
        help="where to look for what the prior does not show: views of the map alone, or of the training poses as well "
        f"(default: map for {', '.join(WITHOUT_PRIOR)}, else none)",
    )
    parser.add_argument("--limit", type=number(int, 0), default=0, help="only the first photos; 0 for all")
    parser.add_argument(
        "--max-width", type=number(int, 1), default=640, help="resize wider photos (default: %(default)s)"
    )
    parser.add_argument("--jobs", type=number(int, 1), help="processes (default: joblib.parallel_config's, or 1)")
    parser.add_argument("--json", type=Path, help="write the results to this file")
    parser.add_argument("--report", type=Path, metavar="DIR", help="write a report, index.html, into this folder")
    return parser


def _check(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Refuse options that do not go together."""
    for name, path in (("--json", options.json), ("--report", options.report)):
        if path and not path.absolute().parent.is_dir():
            parser.error(f"{name} {path}: there is no folder {path.absolute().parent}")
    for name, paths in (("--map", options.map), ("--dataparser-transforms", options.dataparser_transforms)):
        if paths and len(paths) != len(options.scene):
            parser.error(f"{name}: {len(paths)} files for {len(options.scene)} scenes")
    own = ("protocol", "corruption", "degrade")
    if options.suite and (chosen := [name for name in own if getattr(options, name) != parser.get_default(name)]):
        parser.error(f"--suite {options.suite} has its own --{chosen[0]}")
    if (options.priors is not None) != (PRIORS_FILE in options.protocol):
        parser.error(f"--priors and --protocol {PRIORS_FILE} need each other")


def _names(known: Collection[str]) -> Callable[[str], list[str]]:
    """Make the parser of names separated by commas, each one of `known`."""

    def parse(text: str) -> list[str]:
        names = text.split(",")
        unknown = [name for name in names if name not in known]
        if unknown:
            raise argparse.ArgumentTypeError(f"{', '.join(unknown)} is not one of {', '.join(known)}")
        return list(dict.fromkeys(names))

    return parse


def _list(parse: Callable[[str], float]) -> Callable[[str], list[float]]:
    """Make the parser of numbers separated by commas, and of ranges of whole numbers as 0-9."""

    def parse_list(text: str) -> list[float]:
        values: list[float] = []
        for part in text.split(","):
            first, dash, last = part.partition("-")
            if dash and first.isdecimal() and last.isdecimal():
                values += [parse(str(number)) for number in range(int(first), int(last) + 1)]
            else:
                values.append(parse(part))
        if not values:
            raise argparse.ArgumentTypeError(f"{text} is an empty list")
        return list(dict.fromkeys(values))

    return parse_list


if __name__ == "__main__":
    sys.exit(main())
