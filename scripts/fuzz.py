"""Feed damaged maps, caches, transforms, COLMAP models, bags, pictures and messages to what reads them, and count.

    make fuzz                     # ten minutes
    make fuzz ARGS="--seconds 60 --seed 7"
    python scripts/fuzz.py --input fuzz/crash-0-map-ply     # one again

Each input is a valid one with some bits, numbers, runs of bytes or its length changed, by a seed. It runs in a process
of its own kind: a crash or hang ends that and is counted, and its input kept in ./fuzz. The exit status is 1 then.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import shutil
import sys
import tempfile
import time
import traceback
from multiprocessing.sharedctypes import Synchronized, SynchronizedArray
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "test" / "support"))

from fuzz_targets import Target, mutated, targets

# Seconds that an input may take, and bytes that the process may have.
HANG = 10.0
MEMORY = 6 << 30
# Started anew, for the threads of OpenMP, faiss's say, do not live on in a fork: it waits for them for ever.
PROCESSES = multiprocessing.get_context("spawn")
OUTCOMES = ("accepted", "refused", "crash", "hang")


class Counts:
    """How inputs of each target ended, shared between processes."""

    def __init__(self, names: list[str]) -> None:
        self.names = names
        self.ended: SynchronizedArray = PROCESSES.Array("q", len(names) * len(OUTCOMES))
        self.next: Synchronized = PROCESSES.Value("q", 0)
        self.started: Synchronized = PROCESSES.Value("d", 0.0)
        self.running: Synchronized = PROCESSES.Value("q", 0)
        self.peak: Synchronized = PROCESSES.Value("q", 0)

    def add(self, target: int, outcome: str) -> None:
        """Count one more."""
        self.ended[target * len(OUTCOMES) + OUTCOMES.index(outcome)] += 1

    def of(self, outcome: str) -> int:
        """Return the number of one outcome of all targets."""
        return sum(self.ended[OUTCOMES.index(outcome) :: len(OUTCOMES)])

    def __str__(self) -> str:
        rows = [f"{'target':24}" + "".join(f"{outcome:>10}" for outcome in OUTCOMES)]
        for number, name in enumerate(self.names):
            ended = self.ended[number * len(OUTCOMES) : (number + 1) * len(OUTCOMES)]
            rows.append(f"{name:24}" + "".join(f"{count:10}" for count in ended))
        total = " ".join(f"{self.of(outcome)} {outcome}," for outcome in OUTCOMES)
        return "\n".join([*rows, f"{self.next.value} inputs: {total} peak memory {self.peak.value >> 20} MB"])


def run(path: Path, target: Target) -> str:
    """Return how an input in a file ends; raise what is no refusal."""
    try:
        target.read(path)
    except (ValueError, OSError):
        return "refused"
    return "accepted"


def work(counts: Counts, folder: Path, kept: Path, seed: int, until: tuple[float, int]) -> None:
    """Feed inputs until a time or a number is reached, or one ends the process."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, resource.RLIM_INFINITY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    all_targets = list(targets(folder).values())
    path = folder / "input"
    while time.monotonic() < until[0] and counts.next.value < until[1]:
        number = counts.next.value
        counts.next.value += 1
        which = number % len(all_targets)
        target = all_targets[which]
        rng = np.random.default_rng([seed, number])
        content = mutated(rng, target.seeds[int(rng.integers(len(target.seeds)))])
        if target.sign and rng.random() < 0.9:
            content = target.sign(content)
        path.write_bytes(content)
        counts.running.value, counts.started.value = which, time.monotonic()
        try:
            outcome = run(path, target)
        except Exception:
            keep(path, kept, "crash", number, counts.names[which])
            traceback.print_exc()
            outcome = "crash"
        counts.started.value = 0.0
        counts.add(which, outcome)
        counts.peak.value = max(counts.peak.value, 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)


def keep(path: Path, kept: Path, outcome: str, number: int, name: str) -> None:
    """Keep an input, to be looked at."""
    kept.mkdir(exist_ok=True)
    shutil.copy(path, kept / f"{outcome}-{number}-{name.replace(' ', '-')}")


def campaign(seconds: float, inputs: int, seed: int, kept: Path) -> Counts:
    """Feed inputs for so many seconds, and at most so many."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        counts = Counts(list(targets(folder)))
        until = time.monotonic() + seconds, inputs
        while time.monotonic() < until[0] and counts.next.value < inputs:
            shutil.rmtree(folder)
            folder.mkdir()
            counts.started.value = 0.0
            worker = PROCESSES.Process(target=work, args=(counts, folder, kept, seed, until))
            worker.start()
            watch(worker, counts)
            if worker.exitcode:
                outcome = "hang" if counts.started.value < 0 else "crash"
                keep(folder / "input", kept, outcome, counts.next.value - 1, counts.names[counts.running.value])
                counts.add(counts.running.value, outcome)
    return counts


def watch(worker: multiprocessing.process.BaseProcess, counts: Counts) -> None:
    """Wait for the worker; end it where an input takes too long, and note that by a negative start."""
    while worker.is_alive():
        worker.join(0.2)
        started = counts.started.value
        if started > 0 and time.monotonic() - started > HANG:
            worker.kill()
            worker.join()
            counts.started.value = -1.0


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=600.0, help="(default: %(default)s)")
    parser.add_argument("--inputs", type=int, default=10**9, help="at most so many")
    parser.add_argument("--seed", type=int, default=0, help="another one gives other inputs")
    parser.add_argument("--kept", type=Path, default=Path("fuzz"), help="folder of what crashed (default: %(default)s)")
    parser.add_argument("--input", type=Path, help="one that was kept, once more")
    options = parser.parse_args(arguments)
    if options.input:
        with tempfile.TemporaryDirectory() as name:
            by_name = {key.replace(" ", "-"): target for key, target in targets(Path(name)).items()}
            shutil.copy(options.input, Path(name) / "input")
            print(run(Path(name) / "input", by_name[options.input.name.split("-", 2)[2]]))
        return 0
    counts = campaign(options.seconds, options.inputs, options.seed, options.kept)
    print(counts)
    return 1 if counts.of("crash") or counts.of("hang") else 0


if __name__ == "__main__":
    sys.exit(main())
