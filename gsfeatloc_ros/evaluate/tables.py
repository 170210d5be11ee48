"""Results of several runs: as JSON, and as the rows of a table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from gsfeatloc_ros.evaluate.metrics import QueryResult, accuracy, best_of, by_step, summarize
from gsfeatloc_ros.evaluate.protocol import SWEEPS
from gsfeatloc_ros.evaluate.run import Run, Task

_HEADINGS = (
    *("scene", "protocol", "sigma", "method, matcher", "seeds", "queries", "success", "answered", "wrong"),
    *("median deg", "median radii", "NEES/dof", "in 95 %", "median ms"),
)


@dataclass(frozen=True)
class RunResults:
    """What came out of a run: at least one task, each with its result."""

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
    def summary(self) -> dict:
        """Summary of all results, as for a single run."""
        summary = summarize(self.results)
        per_query = summary.pop("per_query")
        if self.run.protocol == "chen":
            summary["best_of_priors"] = accuracy([best for member in self.members for best in best_of(member.results)])
        if self.run.protocol in SWEEPS:
            summary["steps"] = by_step(self.results)
        return {**summary, "per_query": per_query}

    def describe(self) -> dict:
        """Settings and summary, ready for JSON."""
        run = self.run
        return {
            "scene": run.scene.name,
            "protocol": run.protocol,
            "method": run.method,
            "matcher": run.matcher,
            "sigma": run.sigma,
            "seed": run.seed if len(self.members) == 1 else self.seeds,
            "options": dict(run.options),
            "without": run.without,
            "spoil": run.spoil,
            **self.summary,
        }

    @property
    def label(self) -> str:
        """Method, matcher, changed options, what was left out and what is wrong with the photos, in short."""
        run = self.run
        words = [run.method, run.matcher, *(f"{name}={value:g}" for name, value in run.options)]
        words += [f"without {run.without}"] if run.without else []
        words += [f"{run.spoil} photos"] if run.spoil else []
        return " ".join(words)


def over_seeds(runs: Sequence[RunResults]) -> list[Group]:
    """Put together the runs that differ in their seeds alone, in the order in which they come."""
    groups: dict[Run, list[RunResults]] = {}
    for results in runs:
        groups.setdefault(replace(results.run, seed=0), []).append(results)
    return [Group(members) for members in groups.values()]


def describe(runs: Sequence[RunResults]) -> dict:
    """All results, ready for JSON: of a single run as it is, of several as `runs` and, over their seeds, `pooled`."""
    if len(runs) == 1:
        return Group([runs[0]]).describe()
    pooled = [group.describe() for group in over_seeds(runs)]
    for group in pooled:
        del group["per_query"]
    return {"runs": [Group([results]).describe() for results in runs], "pooled": pooled}


def query_table(results: Sequence[QueryResult]) -> str:
    """A table for the terminal with one line a query."""
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


def run_table(groups: Sequence[Group]) -> str:
    """A table for the terminal with one line a group."""
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
                f"{summary['rotation_error_deg']['median']:.3f}",
                f"{summary['translation_error']['median']:.4f}",
                "-" if nees is None else f"{nees:.2f}",
                "-" if coverage is None else f"{100 * coverage['95']:.0f} %",
                f"{summary['milliseconds']['median']:.0f}",
            )
        )
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join("  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)) for row in rows)
