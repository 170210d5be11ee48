"""The table that says whether answers can be trusted: a row for each thing that photos and maps are put through."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsfeatloc_ros.evaluate.metrics import QueryResult
from gsfeatloc_ros.evaluate.negatives import NEGATIVES
from gsfeatloc_ros.evaluate.run import Run
from gsfeatloc_ros.evaluate.suites import Kind, kind_of
from gsfeatloc_ros.evaluate.tables import Group, aligned

_HEADINGS = ("", "queries", "right", "WRONG", "NEES", "in 95 %", "beyond level", "CPU-ms")


@dataclass(frozen=True)
class TrustRow:
    """What came of all queries of one condition, or of one kind.

    Attributes:
        kind: of the condition, see `kind_of`; "all" for the total.
        name: of the condition; "" for the total of its kind.
        queries: number of queries.
        right: number of answers that are right; of photos that are not of the scene, of those without an answer.
        wrong: number of wrong answers.
        answers: number of answers that have a covariance and a truth.
        nees: mean of the NEES per degree of freedom of these; None without any.
        in_ellipsoid: share of these in the 95 % ellipsoid; None without any.
        beyond_level: number of these that are farther off than their protection level says.
        cpu_milliseconds: median CPU time of a query.
    """

    kind: str
    name: str
    queries: int
    right: int
    wrong: int
    answers: int
    nees: float | None
    in_ellipsoid: float | None
    beyond_level: int
    cpu_milliseconds: float

    def cells(self) -> tuple[str, ...]:
        """Return the numbers as texts, in the order of the table's columns, without the name."""
        return (
            str(self.queries),
            f"{100 * self.right / self.queries:.1f} %",
            str(self.wrong),
            "-" if self.nees is None else f"{self.nees:.2f}",
            "-" if self.in_ellipsoid is None else f"{100 * self.in_ellipsoid:.0f} %",
            f"{self.beyond_level} of {self.answers}" if self.answers else "-",
            f"{self.cpu_milliseconds:.0f}",
        )


def trust_rows(groups: Sequence[Group]) -> list[TrustRow]:
    """Return the rows of the groups: for each kind its total and its conditions, then the total.

    Groups of one condition, as of several scenes, are put together.
    """
    kinds: dict[Kind, dict[str, list[QueryResult]]] = {}
    for group in groups:
        run = group.run
        conditions = kinds.setdefault(kind_of(run.corruption, run.degradation, run.negative), {})
        conditions.setdefault(_name(run), []).extend(group.results)
    rows = []
    for kind, conditions in sorted(kinds.items(), key=lambda item: list(Kind).index(item[0])):
        rows.append(_row(kind.value, "", list(itertools.chain.from_iterable(conditions.values()))))
        rows += [_row(kind.value, name, results) for name, results in conditions.items()]
    return [*rows, _row("all", "", [result for group in groups for result in group.results])]


def describe_trust(groups: Sequence[Group]) -> list[dict[str, Any]]:
    """Return the rows, ready for JSON."""
    return [asdict(row) for row in trust_rows(groups)]


def trust_table(groups: Sequence[Group]) -> str:
    """Return the table for the terminal; NEES and all behind it are of the answers."""
    return aligned(
        [_HEADINGS, *((f"  {row.name}" if row.name else row.kind, *row.cells()) for row in trust_rows(groups))]
    )


def _name(run: Run) -> str:
    """Return the name of a run's condition."""
    negative = f"of {Path(run.negative).name}" if run.negative and run.negative not in NEGATIVES else run.negative
    names = [name for name in (run.corruption, run.degradation, negative) if name]
    if run.protocol != "paper" or not names:
        names.append(f"priors of {run.protocol}")
    return ", ".join(names)


def _row(kind: str, name: str, results: Sequence[QueryResult]) -> TrustRow:
    known = [result for result in results if result.nees is not None and result.in_ellipsoid is not None]
    return TrustRow(
        kind=kind,
        name=name,
        queries=len(results),
        right=sum(result.success for result in results),
        wrong=sum(result.verdict == "wrong" for result in results),
        answers=len(known),
        nees=float(np.mean([result.nees for result in known])) if known else None,
        in_ellipsoid=float(np.mean([(result.in_ellipsoid or {})["95"] for result in known])) if known else None,
        beyond_level=sum(bool(result.protection_exceeded) for result in known),
        cpu_milliseconds=float(np.median([result.cpu_milliseconds for result in results])),
    )
