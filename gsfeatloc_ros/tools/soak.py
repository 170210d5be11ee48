"""Let the installed localizer work for minutes on a camera's stream, and measure how it bears it.

A process of its own publishes photos of the simulated room with real-time stamps, their camera_info, and priors that
are off as a robot's odometry is. Meanwhile the services are called every few seconds. Exits with 1 if a target fails.

    gsfeatloc soak --seconds 600 --size 1920x1080 --rate 10 --folder /tmp/soak --json soak.json

With --track the robot has odometry and no priors but the first second's, walks no faster than time, and the node goes
on from its own answers. How many answers a second, how late, and for how much CPU, at 30 Hz on one core:

    gsfeatloc soak --seconds 60 --rate 30 --track --no-calls -p cpu.threads:=1

With --faults a process of its own makes one every two seconds: parameters of no type, malformed messages and requests,
maps that are bombs or pipes, and the map itself with planted caches; all that is asked has to be answered.

With --flood many more requests come on top, from a process of its own, at one time of the stream; it may be given more
than once. 400 requests at 15 a second, and 500 at once:

    gsfeatloc soak --seconds 120 --flood localize_image,400,15,30 --flood relocalize,500,0,80
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
from collections.abc import Sequence
from pathlib import Path

from gsfeatloc_ros.client.faults import run_faults
from gsfeatloc_ros.client.flood import LOCALIZE_IMAGE, RELOCALIZE, Flood, FloodProcess
from gsfeatloc_ros.client.observer import Observer
from gsfeatloc_ros.client.process import isolate_ros, running_localizer
from gsfeatloc_ros.client.robot import Stream, prepare_room, run_robot
from gsfeatloc_ros.client.soak_report import add_core_target, add_floods, summarize
from gsfeatloc_ros.tools.options import add_node_parameters, check_outputs, number, picture_size
from gsfeatloc_ros.tools.status import run_tool


def main(argv: Sequence[str] | None = None) -> int:
    """Run the soak; return the exit status: 1 where it did not go well, 2 where something cannot be used."""
    args = make_parser().parse_args(argv)
    return run_tool("soak", lambda: _soak(args))


def _soak(args: argparse.Namespace) -> int:
    check_outputs(args.json)
    print(f"soak: the map and the photos are kept in {args.folder}", file=sys.stderr)
    stream = Stream(args.size, args.rate, args.seconds, args.track)
    map_file, photos_file = prepare_room(args.folder, stream)
    isolate_ros()
    context = multiprocessing.get_context("spawn")
    robot = context.Process(target=run_robot, args=(photos_file, stream))
    made, unanswered = context.Value("q", 0), context.Value("q", 0)
    faults = context.Process(target=run_faults, args=(map_file.resolve(), args.size, made, unanswered))
    observer = Observer(photos_file, stream, args.calls)
    floods = [FloodProcess(flood, photos_file, stream) for flood in args.flood]
    parameters = {"map.path": map_file.resolve(), "track": args.track} | dict(args.parameter)
    try:
        with running_localizer(parameters) as localizer:
            localizer.wait_until_ready()
            robot.start()
            if args.faults:
                faults.start()
            observer.watch(localizer.pid, robot, floods)
    except (RuntimeError, TimeoutError) as error:
        print(f"soak: {error}", file=sys.stderr)
        return 1
    finally:
        observer.close()
        for process in (robot, faults):
            if process.is_alive():
                process.terminate()
        for flood in floods:
            flood.stop()
    record = observer.record
    if not record.answers or (args.calls and not record.calls):
        print("soak: the localizer gave no pose, or answered no request", file=sys.stderr)
        return 1
    size = f"{args.size[0]}x{args.size[1]}"
    result = {"size": size, "rate": args.rate} | summarize(record, args.seconds)
    if parameters.get("cpu.threads"):
        add_core_target(result, int(parameters["cpu.threads"]))
    if args.faults:
        result |= {"faults": made.value, "faults_unanswered": unanswered.value}
        result["targets"]["faults are answered"] = unanswered.value == 0
    if floods:
        add_floods(result, record, [(flood.flood, flood.replies) for flood in floods])
    print(json.dumps(result, indent=2))
    if args.json:
        samples = [vars(sample) for sample in record.samples]
        calls = {name: [vars(call) for call in calls] for name, calls in record.calls.items()}
        args.json.write_text(json.dumps(result | {"samples": samples, "calls": calls}, indent=1))
    return 0 if all(result["targets"].values()) else 1


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog="gsfeatloc soak", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--seconds", type=number(float, 1), default=600, help="how long (%(default)g); memory still settles before 300"
    )
    parser.add_argument("--size", type=picture_size, default="640x480", help="of the images in pixels (%(default)s)")
    parser.add_argument("--rate", type=number(float, 0.1), default=10.0, help="images a second (%(default)g)")
    parser.add_argument("--folder", type=Path, default=Path("soak"), help="keeps the map and the photos (%(default)s)")
    parser.add_argument(
        "--flood",
        type=_flood,
        action="append",
        default=[],
        help="SERVICE,REQUESTS,RATE,SECOND: requests on top, so many a second (0: at once), from that second on",
    )
    parser.add_argument("--track", action="store_true", help="odometry in place of priors, and track:=true")
    parser.add_argument("--no-calls", dest="calls", action="store_false", help="do not call the services")
    add_node_parameters(parser, "of the node")
    parser.add_argument("--faults", action="store_true", help="make a fault every two seconds")
    parser.add_argument("--json", type=Path, help="file of the results")
    return parser


def _flood(text: str) -> Flood:
    try:
        service, requests, rate, start = text.split(",")
        flood = Flood(service, int(requests), float(rate), float(start))
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not SERVICE,REQUESTS,RATE,SECOND") from error
    if service not in (RELOCALIZE, LOCALIZE_IMAGE):
        raise argparse.ArgumentTypeError(f"{service!r} is neither {RELOCALIZE} nor {LOCALIZE_IMAGE}")
    return flood


if __name__ == "__main__":
    sys.exit(main())
