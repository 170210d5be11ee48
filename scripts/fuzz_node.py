"""Send strange messages, requests, parameters and transitions to the installed localizer, and count.

    python -P scripts/fuzz_node.py --inputs 2000 --seed 7

Each input is drawn by a seed. What has to be answered is to be answered within 10 s (a transition: within a minute),
and the process is to live on, unless it was told to shut down. The exit status is 1 otherwise.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "test" / "support"))

from lifecycle_msgs.srv import ChangeState, GetState
from node_harness import Client, NodeProcess, node_arguments
from node_inputs import SHUTDOWNS, Input, draw_input

from gsfeatloc_ros.client.process import isolate_ros
from gsfeatloc_ros.maps.ply import write_ply
from gsfeatloc_ros.simulate import Room, cover

# Seconds.
HANG, LONG_HANG = 10.0, 60.0
CONFIGURE, ACTIVATE = 1, 3
UNCONFIGURED, INACTIVE, ACTIVE, FINALIZED = 1, 2, 3, 4


class ShutdownError(Exception):
    """The localizer was told to shut down, and is about to."""


class Campaign:
    """Inputs to a localizer, which is started anew where it has ended.

    Attributes:
        ended: number of inputs by kind and outcome.
        peak: most bytes that a localizer took.
    """

    def __init__(self, folder: Path) -> None:
        self.ended: Counter[tuple[str, str]] = Counter()
        self.peak = 0
        map_file = folder / "room.ply"
        write_ply(map_file, cover(Room(seed=0)))
        self._arguments = node_arguments(
            map__path=map_file, localizer__max_views=4, track="true", base_frame="camera_optical"
        )
        self._start()

    def feed(self, given: Input, number: int) -> None:
        """Send an input and count how that ended."""
        try:
            given.send(self._client, LONG_HANG if given.kind == "transition" else HANG)
            # Of a message nothing tells that it was taken: a request that comes after it does.
            if given.kind == "transition" or number % 10 == 0:
                self._bring_up()
            outcome = "passed"
        except (AssertionError, ShutdownError) as error:
            outcome = self._end_of(given, isinstance(error, ShutdownError))
            if outcome != "shut down":
                print(f"{given.kind} {number}: {outcome}: {error}\n{self._process.output[-2000:]}", file=sys.stderr)
            self.close()
            self._start()
        self.ended[given.kind, outcome] += 1

    def close(self) -> None:
        """End the localizer."""
        self._measure()
        self._client.close()
        if self._process.alive:
            self._process.stop()
        self._process.close()

    def _start(self) -> None:
        self._process = NodeProcess(*self._arguments)
        self._process.wait_until_ready()
        self._client = Client()
        self._client.connect()

    def _end_of(self, given: Input, finalized: bool) -> str:
        """Return how a localizer that is gone, or did not answer, has ended."""
        told_to = finalized or (given.kind == "transition" and given.what in SHUTDOWNS)
        try:
            status = self._process.wait(HANG if told_to else 1.0)
        except subprocess.TimeoutExpired:
            return "hang"
        return "shut down" if told_to and status == 0 else "crash"

    def _bring_up(self) -> None:
        """Let it serve again; raise AssertionError where it does not, ShutdownError where it was told to end."""
        self._measure()
        call = self._client.call
        for _ in range(3):
            state = call(GetState, "localizer/get_state", GetState.Request(), HANG).current_state.id
            if state == ACTIVE:
                return
            if state == FINALIZED:
                raise ShutdownError
            request = ChangeState.Request()
            request.transition.id = {UNCONFIGURED: CONFIGURE, INACTIVE: ACTIVATE}.get(state, 0)
            call(ChangeState, "localizer/change_state", request, LONG_HANG)
        raise AssertionError(f"it is not active but in state {state}")

    def _measure(self) -> None:
        status = Path(f"/proc/{self._process.pid}/status")
        peak = re.search(r"VmHWM:\s+(\d+) kB", status.read_text()) if status.exists() else None
        self.peak = max(self.peak, 1024 * int(peak[1]) if peak else 0)

    def __str__(self) -> str:
        outcomes = ("passed", "shut down", "crash", "hang")
        kinds = sorted({kind for kind, _ in self.ended})
        rows = [f"{'input':24}" + "".join(f"{outcome:>10}" for outcome in outcomes)]
        rows += [f"{kind:24}" + "".join(f"{self.ended[kind, outcome]:10}" for outcome in outcomes) for kind in kinds]
        total = ", ".join(f"{sum(self.ended[kind, outcome] for kind in kinds)} {outcome}" for outcome in outcomes)
        return "\n".join([*rows, f"{self.ended.total()} inputs: {total}, peak memory {self.peak >> 20} MB"])

    @property
    def failed(self) -> bool:
        """Whether any input ended or stopped it."""
        return any(outcome in ("crash", "hang") for _, outcome in self.ended)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=120.0, help="(default: %(default)s)")
    parser.add_argument("--inputs", type=int, default=10**9, help="at most so many")
    parser.add_argument("--seed", type=int, default=0, help="another one gives other inputs")
    options = parser.parse_args(arguments)
    isolate_ros()
    with tempfile.TemporaryDirectory() as name:
        pipe = Path(name) / "pipe.ply"
        os.mkfifo(pipe)
        campaign = Campaign(Path(name))
        until = time.monotonic() + options.seconds
        try:
            for number in range(options.inputs):
                if time.monotonic() > until:
                    break
                campaign.feed(draw_input(np.random.default_rng([options.seed, number]), pipe), number)
        finally:
            campaign.close()
    print(campaign)
    return 1 if campaign.failed else 0


if __name__ == "__main__":
    sys.exit(main())
