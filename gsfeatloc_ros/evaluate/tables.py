"""Results of several runs: as JSON, and as texts for the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from gsfeatloc_ros.evaluate.metrics import (
    MAX_ROTATION_ERROR_DEG,
    MAX_TRANSLATION_ERROR,
    QueryResult,
    accuracy,
    best_of,
    by_step,
    summarize,
)
from gsfeatloc_ros.evaluate.negatives import NEGATIVES
from gsfeatloc_ros.evaluate.protocol import SWEEPS
from gsfeatloc_ros.evaluate.run import Run, Task

_HEADINGS = (
    *("scene", "protocol", "sigma", "method, matcher", "seeds", "queries", "success", "answered", "wrong"),
    *("median deg", "median radii", "NEES/dof", "in 95 %", "median ms"),
)


@dataclass(frozen=True)
class RunResults:
    """The tasks of a run, at least one, each with its result."""

    run: Run
    tasks: list[Task]
    results: list[QueryResult]


@dataclass(frozen=True)
class Group:
    """Runs that differ in their seeds alone: a row of a table."""

    members: list[RunResults]

    @property
    def run(self) -> Run:
        """The first of the runs."""
        return self.members[0].run

    @property
    def seeds(self) -> str:
        """The seeds in short: "0-9" or "0,2,5"."""
        seeds = [member.run.seed for member in self.members]
        if len(seeds) > 2 and seeds == list(range(seeds[0], seeds[0] + len(seeds))):
            return f"{seeds[0]}-{seeds[-1]}"
        return ",".join(map(str, seeds))

    @property
    def results(self) -> list[QueryResult]:
        """The results of all runs."""
        return [result for member in self.members for result in member.results]

    @cached_property
    def summary(self) -> dict[str, Any]:
        """Summary of all results, as for a single run."""
        summary = summarize(self.results)
        per_query = summary.pop("per_query")
        if self.run.protocol == "chen":
            summary["best_of_priors"] = accuracy([best for member in self.members for best in best_of(member.results)])
        if self.run.protocol in SWEEPS:
            summary["steps"] = by_step(self.results)
        return {**summary, "per_query": per_query}

    def describe(self) -> dict[str, Any]:
        """Return settings and summary, ready for JSON."""
        run = self.run
        return {
            "scene": run.scene.name,
            "protocol": run.protocol,
            "method": run.method,
            "matcher": run.matcher,
            "sigma": run.sigma,
            "seed": run.seed if len(self.members) == 1 else self.seeds,
            "options": dict(run.options),
            "ablation": run.ablation,
            "corruption": run.corruption,
            "degradation": run.degradation,
            "negative": Path(run.negative).name,
            **self.summary,
        }

    @property
    def label(self) -> str:
        """Method, matcher, changed options, ablation and condition in short."""
        run = self.run
        words = [run.method, run.matcher, *(f"{name}={value:g}" for name, value in run.options)]
        words += [f"without {run.ablation}"] if run.ablation else []
        return " ".join([*words, *condition_words(run)])


def condition_words(run: Run) -> list[str]:
    """Return what is done to the photos and the map of a run in words; none: nothing."""
    words = [f"{run.corruption} photos"] if run.corruption else []
    words += [f"{run.degradation} map"] if run.degradation else []
    if run.negative in NEGATIVES:
        words += [f"not of the scene: {run.negative}"]
    elif run.negative:
        words += [f"not of the scene: of {Path(run.negative).name}"]
    return words


def over_seeds(runs: Sequence[RunResults]) -> list[Group]:
    """Put together the runs that differ in their seeds alone, in the order in which they come."""
    groups: dict[Run, list[RunResults]] = {}
    for results in runs:
        groups.setdefault(replace(results.run, seed=0), []).append(results)
    return [Group(members) for members in groups.values()]


def describe(runs: Sequence[RunResults]) -> dict[str, Any]:
    """Return all results, ready for JSON: of one run as it is, of several as `runs` and, over their seeds, `pooled`."""
    if len(runs) == 1:
        return Group([runs[0]]).describe()
    pooled = [group.describe() for group in over_seeds(runs)]
    for group in pooled:
        del group["per_query"]
    return {"runs": [Group([results]).describe() for results in runs], "pooled": pooled}


def query_table(results: Sequence[QueryResult]) -> str:
    """Return a table with one line a query."""
    width = max(len(result.photo) for result in results)
    lines = [f"{'photo':{width}}     prior error      final error   matches  inliers     ms"]
    for result in results:
        line = (
            f"{result.photo:{width}}  {result.prior_rotation_error_deg:5.1f} deg {result.prior_translation_error:5.3f}"
            f"  {result.rotation_error_deg:6.3f} deg {result.translation_error:6.4f}"
            f"  {result.evidence['matches']:7}  {result.evidence['inliers']:7}  {result.milliseconds:5.0f}"
        )
        if not result.answered:
            line += f"  NOT ANSWERED: {result.reason}"
        elif not result.success:
            line += "  WRONG"
        lines.append(line)
    return "\n".join(lines)


def run_table(groups: Sequence[Group]) -> str:
    """Return a table with one line a group."""
    rows = [_HEADINGS]
    for group in groups:
        run, summary = group.run, group.summary
        nees, coverage = summary["nees_mean"], summary["coverage"]
        rows.append(
            (
                run.scene.name,
                run.protocol,
                f"{run.sigma:g}",
                group.label,
                group.seeds,
                str(summary["queries"]),
                f"{100 * summary['success_rate']:.1f} %",
                str(summary["answered"]),
                str(summary["wrong_answers"]),
                "-" if run.negative else f"{summary['rotation_error_deg']['median']:.3f}",
                "-" if run.negative else f"{summary['translation_error']['median']:.4f}",
                "-" if nees is None else f"{nees:.2f}",
                "-" if coverage is None else f"{100 * coverage['95']:.0f} %",
                f"{summary['milliseconds']['median']:.0f}",
            )
        )
    return aligned(rows)


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Return rows of cells as lines, the columns aligned."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)) for row in rows]
    return "\n".join(line.rstrip() for line in lines)


def run_summary(report: dict[str, Any]) -> str:
    """Return what came out of a single run, described by `describe`, in lines."""
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
