"""An evaluation from start to end: all combinations of settings, what a record has of them, and the rest localized."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from gsfeatloc_ros.evaluate.dataset import Scene
from gsfeatloc_ros.evaluate.metrics import QueryResult
from gsfeatloc_ros.evaluate.protocol import WITHOUT_PRIOR
from gsfeatloc_ros.evaluate.record import Fingerprint, Record, SceneHash, fingerprint_of, hash_photos, hash_scene
from gsfeatloc_ros.evaluate.run import (
    PRIORS_FILE,
    Run,
    Task,
    draw_priors,
    load_negative_scene,
    localize_all,
    run_negatives,
)
from gsfeatloc_ros.evaluate.scene import load_scene
from gsfeatloc_ros.evaluate.suites import Condition
from gsfeatloc_ros.evaluate.tables import RunResults


@dataclass(frozen=True)
class Combinations:
    """Settings of which all combinations are run.

    Attributes:
        scenes: folders with their maps, None for the map in the folder, and nerfstudio's files of where these lie, None
            where they lie in the scene's frame.
        conditions: what is done to the photos, priors and maps.
        priors_file: for the protocol PRIORS_FILE.
        max_width: as in Run, one for all.
        index: as in Run; None for an index of the map where priors need one.
        options: values by the name of a parameter of LocalizerOptions.
        methods, matchers, sigmas, seeds, ablations: as in Run.
    """

    scenes: Sequence[tuple[Path, Path | None, Path | None]]
    conditions: Sequence[Condition]
    priors_file: Path | None
    methods: Sequence[str]
    matchers: Sequence[str]
    sigmas: Sequence[float]
    seeds: Sequence[int]
    max_width: int
    options: dict[str, list[float]]
    ablations: Sequence[str] = ("",)
    index: str | None = None

    def runs(self) -> list[Run]:
        """Return all combinations, those next to each other that need the same map and matcher."""
        values = [[(name, value) for value in values] for name, values in self.options.items()]
        folders = [scene for scene, _, _ in self.scenes]
        return [
            Run(
                scene=scene,
                map_path=map_path,
                protocol=condition.protocol,
                priors_file=self.priors_file if condition.protocol == PRIORS_FILE else None,
                method=method,
                matcher=matcher,
                sigma=sigma,
                seed=seed,
                max_width=self.max_width,
                options=options,
                ablation=ablation,
                corruption=condition.corruption,
                degradation=condition.degradation,
                negative=negative,
                index=self.index or ("map" if condition.protocol in WITHOUT_PRIOR else "none"),
                dataparser_transforms=dataparser_transforms,
            )
            for scene, map_path, dataparser_transforms in self.scenes
            for degradation in dict.fromkeys(condition.degradation for condition in self.conditions)
            for matcher, method, sigma, seed in itertools.product(self.matchers, self.methods, self.sigmas, self.seeds)
            # The published recipe has no options and is taken whole.
            for options in (itertools.product(*values) if method == "default" else [()])
            for ablation in (self.ablations if method == "default" else [""])
            for condition in self.conditions
            if condition.degradation == degradation
            for negative in condition.negatives(scene, folders)
        ]


class Evaluation:
    """Runs with what a record has of their results; `localize` does the rest.

    Attributes:
        record: where the results are kept.
        recorded: number of results that the record had of any run when the evaluation began.
        queries: number of queries of all runs.
    """

    def __init__(self, runs: Sequence[Run], limit: int, record: Record) -> None:
        """Load the scenes, draw the priors and look up what the record has.

        Args:
            runs: those of one scene next to each other.
            limit: only the first photos of each scene; 0 for all.
            record: where the results are kept.

        Raises:
            ValueError, RuntimeError, OSError: a scene or a file of priors cannot be used.
        """
        self.record = record
        self.recorded = len(record)
        self._plans = {plan.run: plan for plan in _plans(runs, limit, record)}
        self.queries = sum(len(plan.tasks) for plan in self._plans.values())

    @property
    def to_do(self) -> list[Task]:
        """The tasks that have no result yet."""
        return [task for plan in self._plans.values() for task in plan.tasks if _query(task) not in plan.found]

    def localize(self, jobs: int | None) -> Iterator[Task]:
        """Localize what is to do, and yield each task when its result is in the record; arguments as `localize_all`."""
        for task, result in localize_all(self.to_do, jobs):
            plan = self._plans[task.run]
            plan.found[_query(task)] = result
            self.record.append(plan.fingerprint, result)
            yield task

    def results(self) -> list[RunResults]:
        """Return the results of all runs, once nothing is left to do."""
        return [
            RunResults(plan.run, plan.tasks, [plan.found[_query(task)] for task in plan.tasks])
            for plan in self._plans.values()
        ]


@dataclass(frozen=True)
class _Plan:
    """A run with its tasks, and the results that are there of them by photo and step."""

    run: Run
    fingerprint: Fingerprint
    tasks: list[Task]
    found: dict[tuple[str, int], QueryResult]


def _plans(runs: Sequence[Run], limit: int, record: Record) -> Iterator[_Plan]:
    """Yield the tasks of all runs with what the record has of them."""
    for (folder, map_path), group in itertools.groupby(runs, key=lambda run: (run.scene, run.map_path)):
        scene = load_scene(folder, map_path)
        hashes = _Hashes(hash_scene(scene))
        for run in group:
            other = load_negative_scene(run)
            if run.negative:
                negatives = run_negatives(run, scene, other)
                every = [(negative.name, negative.prior) for negative in negatives]
                chosen = every[: limit or None]
            else:
                every = [(scene.photos[prior.photo].name, prior) for prior in draw_priors(run, scene)]
                chosen = [(name, prior) for name, prior in every if not limit or prior.photo < limit]
            if not chosen:
                raise ValueError(f"{run.priors_file}: has no prior of the first {limit or len(scene.photos)} photos")
            fingerprint = fingerprint_of(run, hashes.together(other), [prior for _, prior in every])
            tasks = [Task(run, fingerprint.version, name, prior) for name, prior in chosen]
            yield _Plan(run, fingerprint, tasks, record.done(fingerprint))


@dataclass(frozen=True)
class _Hashes:
    """Hashes of a scene, and of the others whose photos are looked for in it, by their names."""

    scene: SceneHash
    others: dict[str, str] = field(default_factory=dict)

    def together(self, other: Scene | None) -> SceneHash:
        """Return the hashes of the scene with the photos of another, if any."""
        if other is None:
            return self.scene
        if other.name not in self.others:
            self.others[other.name] = hash_photos(other)
        return SceneHash(self.scene.map, self.scene.photos + self.others[other.name])


def _query(task: Task) -> tuple[str, int]:
    """Return what tells a task from the others of its run: the photo and the step."""
    return task.photo, task.prior.step
