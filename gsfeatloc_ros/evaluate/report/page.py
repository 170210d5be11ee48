"""The page of the report, filled."""

from __future__ import annotations

import datetime
import os
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from gsfeatloc_ros.evaluate.extras import import_extra
from gsfeatloc_ros.evaluate.metrics import MAX_ROTATION_ERROR_DEG, MAX_TRANSLATION_ERROR
from gsfeatloc_ros.evaluate.protocol import SWEEPS
from gsfeatloc_ros.evaluate.report import figures
from gsfeatloc_ros.evaluate.report.paper import SOURCE, PublishedTable, published_table
from gsfeatloc_ros.evaluate.report.worst import WorstQuery, worst_queries
from gsfeatloc_ros.evaluate.run import PRIORS_FILE, Run
from gsfeatloc_ros.evaluate.tables import Group, RunResults, condition_words, over_seeds
from gsfeatloc_ros.evaluate.trust import TrustRow, trust_rows

# More do not fit into a figure.
_MAX_DRAWN = 7


@dataclass(frozen=True)
class Case:
    """The groups of a scene, protocol and sigma: what is compared in one place.

    Attributes:
        groups: of several methods, matchers and options.
        trust: rows of the table of all that photos and map were put through; none where that was nothing.
        published: what was published of the scene's data set under this protocol, None if nothing.
        figures: captions and SVG.
    """

    groups: list[Group]
    trust: list[TrustRow]
    published: PublishedTable | None
    figures: list[tuple[str, str]]

    @property
    def run(self) -> Run:
        """A run of the case."""
        return self.groups[0].run

    @property
    def is_sweep(self) -> bool:
        """Whether the priors are the steps of a sweep."""
        return self.run.protocol in SWEEPS

    @property
    def title(self) -> str:
        """How the priors were made."""
        sigma = "" if self.run.protocol == PRIORS_FILE else f", sigma {self.run.sigma:g}"
        return f"protocol {self.run.protocol}{sigma}"


def write_report(folder: Path, runs: Sequence[RunResults], command: str) -> Path:
    """Write `index.html`, with figures and pictures in it, into a folder; return its path.

    Args:
        folder: an existing folder.
        runs: at least one.
        command: the command line that gave these results.

    Raises:
        RuntimeError: jinja2 or matplotlib is not installed.
    """
    environment = import_extra("jinja2").Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters["percent"] = lambda share, digits=1: f"{100 * share:.{digits}f} %"
    template = files(__package__).joinpath("page.html.j2").read_text(encoding="utf-8")
    groups = over_seeds(runs)
    cases = _cases(groups)
    page = environment.from_string(template).render(
        cases=cases,
        trust=_trust(groups) if len({group.run.scene for group in groups}) > 1 else [],
        worst=_worst(runs),
        scenes=sorted({case.run.scene.name for case in cases}),
        queries=sum(len(group.results) for case in cases for group in case.groups),
        source=SOURCE,
        max_rotation=MAX_ROTATION_ERROR_DEG,
        max_translation=MAX_TRANSLATION_ERROR,
        date=datetime.datetime.now().astimezone().strftime("%d %B %Y, %H:%M %Z"),
        machine=f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        command=command,
    )
    path = folder / "index.html"
    path.write_text(page, encoding="utf-8")
    return path


def _cases(groups: Sequence[Group]) -> list[Case]:
    together: dict[tuple, list[Group]] = {}
    for group in groups:
        run = group.run
        together.setdefault((run.scene, run.map_path, run.protocol, run.sigma), []).append(group)
    return [_case(groups) for groups in together.values()]


def _trust(groups: list[Group]) -> list[TrustRow]:
    return trust_rows(groups) if any(condition_words(group.run) for group in groups) else []


def _case(groups: list[Group]) -> Case:
    run = groups[0].run
    # Where much is compared, what nothing was done to.
    drawn_groups = [group for group in groups if not condition_words(group.run)] if len(groups) > _MAX_DRAWN else groups
    named = [(group.label, group.results) for group in (drawn_groups or groups)[:_MAX_DRAWN]]
    trust = _trust(groups)
    if run.protocol in SWEEPS:
        curves = figures.success_curves(named, rotation=run.protocol == "sweep-rotation")
        return Case(groups, trust, None, [("Success against the error of the prior.", curves)])
    drawn = [
        (
            f"How large the errors are. The red line is the largest error of a success, {MAX_ROTATION_ERROR_DEG:g}° "
            f"and {MAX_TRANSLATION_ERROR:g} radii; a photo that was not answered has the error of its prior.",
            figures.error_histograms(named),
        )
    ]
    with_covariance = [(name, [r for r in results if r.nees is not None]) for name, results in named]
    with_covariance = [(name, results) for name, results in with_covariance if results]
    if with_covariance:
        caption = (
            "Whether the covariance of the answers can be believed. Left: on the dashed line it can; above it, answers "
            "are better than it says, below it worse; chance alone keeps so few photos within the grey band nine times "
            "in ten. Right: the spread that the normalised error has, and should have."
        )
        drawn.append((caption, figures.calibration(with_covariance)))
    drawn.append(("Where the time goes.", figures.stage_times(named)))
    # The published table is of priors with sigma 1.
    published = published_table(run.scene.name) if run.protocol == "paper" and run.sigma == 1 else None
    return Case(groups, trust, published, drawn)


def _worst(runs: Sequence[RunResults]) -> list[tuple[str, list[WorstQuery]]]:
    """Return the worst queries of each scene: of this package's method if it was run, and not of sweeps if possible."""
    worst = []
    for scene in dict.fromkeys(results.run.scene for results in runs):
        chosen = [results for results in runs if results.run.scene == scene]
        for wanted in (lambda run: run.method == "default", lambda run: run.protocol not in SWEEPS):
            chosen = [results for results in chosen if wanted(results.run)] or chosen
        worst.append((scene.name, worst_queries(chosen)))
    return worst
