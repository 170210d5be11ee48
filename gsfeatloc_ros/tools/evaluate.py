"""Localizes the test photos of scenes from wrong priors and says how well.

    python -m gsfeatloc_ros.tools.evaluate SCENE --method default --matcher xfeat --json result.json
    python -m gsfeatloc_ros.tools.evaluate SCENE... --method default,published --matcher sift,xfeat --seed 0-9 \\
        --jobs 4 --report report

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
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from tqdm import tqdm

from gsfeatloc_ros.evaluate.ablation import PIECES
from gsfeatloc_ros.evaluate.corruptions import SPOILERS
from gsfeatloc_ros.evaluate.metrics import MAX_ROTATION_ERROR_DEG, MAX_TRANSLATION_ERROR, QueryResult
from gsfeatloc_ros.evaluate.protocol import PROTOCOLS
from gsfeatloc_ros.evaluate.record import Fingerprint, Record, fingerprint_of, hash_scene
from gsfeatloc_ros.evaluate.run import METHODS, PRIORS_FILE, Run, Task, draw_priors, localize_all
from gsfeatloc_ros.evaluate.scene import load_scene
from gsfeatloc_ros.evaluate.tables import RunResults, describe, over_seeds, query_table, run_table
from gsfeatloc_ros.match import DEFAULT_MATCHER, MATCHERS
from gsfeatloc_ros.tools.options import Settings, localizer_options, number, setting

_NOTHING = "nothing"


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status.

    It is 0 when all photos were tried, 1 when something cannot be used and 130 when the user interrupted it.
    """
    parser = _parser()
    options = parser.parse_args(arguments)
    _check(parser, options)
    try:
        results = _evaluate(options)
        if options.json:
            options.json.write_text(json.dumps(describe(results), indent=2, allow_nan=False) + "\n", encoding="utf-8")
        if options.report:
            from gsfeatloc_ros.evaluate.report import write_report

            command = shlex.join(["python", "-m", "gsfeatloc_ros.tools.evaluate", *(arguments or sys.argv[1:])])
            print(f"evaluate: wrote {write_report(options.report, results, command)}")
    except (ValueError, RuntimeError, OSError) as error:  # a scene, map, weights or file that cannot be used
        print(f"evaluate: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("evaluate: interrupted; the same command goes on from here", file=sys.stderr)
        return 130
    return 0


@dataclass
class _Plan:
    """A run with its tasks, and the results that are there of them."""

    run: Run
    fingerprint: Fingerprint
    tasks: list[Task]
    found: dict[tuple[str, int], QueryResult]


def _evaluate(options: argparse.Namespace) -> list[RunResults]:
    """Do all runs, but for what the record has already, and print what came out."""
    record = Record(_record_path(options))
    kept = len(record)
    plans = {plan.run: plan for plan in _plans(options, record)}
    to_do = [task for plan in plans.values() for task in plan.tasks if _query(task) not in plan.found]
    queries = sum(len(plan.tasks) for plan in plans.values())
    for note in record.notes:
        print(f"evaluate: {note}")
    if kept:
        print(f"evaluate: {record.path}: has {queries - len(to_do)} of the {queries} results already")

    with tqdm(total=queries, initial=queries - len(to_do), unit="photo") as progress:
        for task, result in localize_all(to_do, options.jobs):
            plan = plans[task.run]
            plan.found[_query(task)] = result
            record.append(plan.fingerprint, result)
            progress.set_description(f"{task.run.scene.name} {task.run.method} {task.run.matcher}", refresh=False)
            progress.update()
    results = [
        RunResults(plan.run, plan.tasks, [plan.found[_query(task)] for task in plan.tasks]) for plan in plans.values()
    ]
    if len(results) == 1:
        print(query_table(results[0].results))
        print(_summary(describe(results)))
    else:
        print(run_table(over_seeds(results)))
    return results


def _plans(options: argparse.Namespace, record: Record) -> Iterator[_Plan]:
    """The tasks of all runs, and what the record has of them."""
    for (folder, map_path), runs in itertools.groupby(_runs(options), key=lambda run: (run.scene, run.map_path)):
        scene = load_scene(folder, map_path)
        scene_hash = hash_scene(scene)
        limit = options.limit or len(scene.photos)
        for run in runs:
            priors = draw_priors(run, scene)
            fingerprint = fingerprint_of(run, scene_hash, priors)
            tasks = [
                Task(run, fingerprint.version, scene.photos[prior.photo].name, prior)
                for prior in priors
                if prior.photo < limit
            ]
            if not tasks:
                raise ValueError(f"{run.priors_file}: has no prior of the first {limit} photos")
            yield _Plan(run, fingerprint, tasks, record.done(fingerprint))


def _query(task: Task) -> tuple[str, int]:
    """What tells a task from the others of its run."""
    return task.photo, task.prior.step


def _record_path(options: argparse.Namespace) -> Path | None:
    """Where the results are kept, each as soon as it is there."""
    if options.report:
        options.report.mkdir(parents=True, exist_ok=True)
        return options.report / "results.jsonl"
    return options.json and options.json.with_suffix(".jsonl")


def _runs(options: argparse.Namespace) -> list[Run]:
    """All combinations of the options, those next to each other that need the same map and matcher."""
    maps = options.map or [None] * len(options.scene)
    sets = [[(name, value) for value in values] for name, values in options.set.items()]
    return [
        Run(
            scene=scene.resolve(),
            map_path=map_path and map_path.resolve(),
            protocol=protocol,
            priors_file=options.priors.resolve() if protocol == PRIORS_FILE else None,
            method=method,
            matcher=matcher,
            sigma=sigma,
            seed=seed,
            max_width=options.max_width,
            options=changed,
            without=without.replace(_NOTHING, ""),
            spoil=spoil.replace(_NOTHING, ""),
        )
        for scene, map_path in zip(options.scene, maps, strict=True)
        for matcher, method, protocol, sigma, seed in itertools.product(
            options.matcher, options.method, options.protocol, options.sigma, options.seed
        )
        # The published recipe has no options and is taken whole.
        for changed in (itertools.product(*sets) if method == "default" else [()])
        for without in (options.without if method == "default" else [_NOTHING])
        for spoil in options.spoil
    ]


def _summary(report: dict) -> str:
    """What came out of a single run, for the terminal."""
    rotation, translation, time = (report[key] for key in ("rotation_error_deg", "translation_error", "milliseconds"))
    lines = [
        f"\n{report['scene']}, protocol {report['protocol']} (sigma {report['sigma']:g}, seed {report['seed']}), "
        f"method {report['method']}, matcher {report['matcher']}",
        f"  success            {100 * report['success_rate']:.1f} % of {report['queries']} "
        f"(< {MAX_ROTATION_ERROR_DEG:g} deg and < {MAX_TRANSLATION_ERROR:g} of the trajectory's radius)",
        f"  answered           {report['answered']}, of which wrong {report['wrong_answers']}",
        f"  rotation error     median {rotation['median']:.3f} deg, mean {rotation['mean']:.3f} deg",
        f"  translation error  median {translation['median']:.4f}, mean {translation['mean']:.4f} (over the radius)",
    ]
    if report["coverage"]:
        held = ", ".join(f"{100 * share:.0f} % in the {percent} %" for percent, share in report["coverage"].items())
        lines.append(
            f"  covariance         NEES {report['nees_mean']:.2f} a degree of freedom (median "
            f"{report['nees_median']:.2f}); of the truths {held} ellipsoid"
        )
    if "best_of_priors" in report:
        best = report["best_of_priors"]
        lines.append(
            f"  best of the priors success {100 * best['success_rate']:.1f} % of {best['queries']} photos, median "
            f"{best['rotation_error_deg']['median']:.3f} deg, {best['translation_error']['median']:.4f}"
        )
    for step in report.get("steps", []):
        lines.append(
            f"  prior off by       {step['prior_rotation_error_deg']:5.1f} deg, {step['prior_translation_error']:.3f}: "
            f"success {100 * step['success_rate']:5.1f} %, wrong {step['wrong_answers']}"
        )
    lines.append(f"  time per photo     median {time['median']:.0f} ms, 95 % within {time['p95']:.0f} ms")
    lines.append("  (a photo that was not answered has the errors of its prior)")
    return "\n".join(lines)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="evaluate",
        description="Localize the test photos of scenes from wrong priors.",
        epilog="LIST: one or several, separated by commas; numbers also as 0-9. All combinations are run.",
    )
    parser.add_argument(
        "scene",
        type=Path,
        nargs="+",
        help="folder with a map, photos and transforms.json, transforms_test.json or sparse/0",
    )
    parser.add_argument("--map", type=Path, action="append", help="map of the scene; once for each scene")
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
        "--seed", type=_list(number(int, 0)), default=[0], metavar="LIST", help="seeds of the priors and of RANSAC"
    )
    parser.add_argument(
        "--set",
        type=setting(_list),
        default={},
        action=Settings,
        metavar="OPTION=LIST",
        help=f"change an option of method default: {', '.join(localizer_options())}",
    )
    parser.add_argument(
        "--without",
        type=_names((_NOTHING, *PIECES)),
        default=[_NOTHING],
        metavar="LIST",
        help=f"take a piece out of method default, one at a time: {', '.join(PIECES)} (default: {_NOTHING})",
    )
    parser.add_argument(
        "--spoil",
        type=_names((_NOTHING, *SPOILERS)),
        default=[_NOTHING],
        metavar="LIST",
        help=f"make something wrong with the photos, one at a time: {', '.join(SPOILERS)} (default: {_NOTHING})",
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
    if options.map and len(options.map) != len(options.scene):
        parser.error(f"--map: {len(options.map)} maps for {len(options.scene)} scenes")
    if (options.priors is not None) != (PRIORS_FILE in options.protocol):
        parser.error(f"--priors and --protocol {PRIORS_FILE} need each other")


def _names(known: Sequence[str]) -> Callable[[str], list[str]]:
    def parse(text: str) -> list[str]:
        names = text.split(",")
        unknown = [name for name in names if name not in known]
        if unknown:
            raise argparse.ArgumentTypeError(f"{', '.join(unknown)} is not one of {', '.join(known)}")
        return list(dict.fromkeys(names))

    return parse


def _list(parse: Callable[[str], float]) -> Callable[[str], list[float]]:
    """Parse numbers separated by commas, and ranges of whole numbers as 0-9."""

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
