"""Compile the kernels and fetch a matcher's weights ahead of use, so that a robot's first start is a fast one.

gsfeatloc warmup
gsfeatloc warmup --matcher xfeat
"""

from __future__ import annotations

import argparse
import sys
import time

from gsfeatloc_ros.common.kernel_cache import kernel_cache_folder
from gsfeatloc_ros.localize.engine import load_matcher
from gsfeatloc_ros.localize.first_run import warm_up
from gsfeatloc_ros.localize.settings import MatcherSettings
from gsfeatloc_ros.match import MATCHERS
from gsfeatloc_ros.render import DEVICES
from gsfeatloc_ros.tools.status import run_tool


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status: 0, or 2 where weights or device cannot be used."""
    options = make_parser().parse_args(arguments)
    return run_tool("warmup", lambda: _warm_up(options))


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog="gsfeatloc warmup", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--matcher", choices=MATCHERS, help="get its weights as well, and localize with it once")
    parser.add_argument("--weights", default="", help="path of the weights, as the parameter matcher.weights")
    parser.add_argument("--device", choices=DEVICES, default="auto", help="to render on (default: %(default)s)")
    return parser


def _warm_up(options: argparse.Namespace) -> int:
    start = time.perf_counter()
    matcher = None
    if options.matcher:
        matcher = load_matcher(MatcherSettings(options.matcher, options.weights), options.device)
    loaded = time.perf_counter()
    done = warm_up(matcher, options.device)
    compiled = f"{done.compiled} functions compiled" if done.compiled else "all in the cache"
    print(f"kernels: {compiled}, {done.kernels_seconds:.1f} s; kept in {kernel_cache_folder()}")
    if done.estimate is not None:
        print(f"matcher {options.matcher}: ready in {loaded - start:.1f} s")
        seconds, estimate = done.localization_seconds, done.estimate
        print(f"a localization in a made-up map: {estimate.status.value} in {seconds:.1f} s: {estimate.reason}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
