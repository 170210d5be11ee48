"""Measure the parts that decide how fast and how right an answer is.

    gsfeatloc benchmark synthetic --gaussians 1000000 --out map.ply
    gsfeatloc benchmark render --map map.ply --size 640x480 --json frames.json
    gsfeatloc benchmark render --scene SCENE
    gsfeatloc benchmark opensplat --map map.ply --checkout OpenSplat
    gsfeatloc benchmark query --scene SCENE --matcher xfeat --json query.json
    gsfeatloc benchmark track --scene SCENE --json track.json
    gsfeatloc benchmark scaling --out scaling.png
    gsfeatloc benchmark index --out index.png
    gsfeatloc benchmark twins --share 0,0.02 --photos 200
    gsfeatloc benchmark planar --views 12,24,48
    gsfeatloc benchmark building --rooms 2,10,40,100 --folder /tmp
    gsfeatloc benchmark pnp

CPU milliseconds count all threads; on a shared machine they, and ratios within one run, mean more than wall time.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import Any

from gsfeatloc_ros.benchmark import index_scaling
from gsfeatloc_ros.benchmark.building import measure_buildings
from gsfeatloc_ros.benchmark.frames import measure_map, measure_scene, pinhole, print_frames, view_of_all
from gsfeatloc_ros.benchmark.measure import machine
from gsfeatloc_ros.benchmark.planar import measure_planar
from gsfeatloc_ros.benchmark.pnp import measure_pnp
from gsfeatloc_ros.benchmark.query import measure_queries, print_queries
from gsfeatloc_ros.benchmark.scaling import COUNTS, draw_scaling, measure_scaling
from gsfeatloc_ros.benchmark.track import measure_tracking, print_tracking
from gsfeatloc_ros.benchmark.twins import measure_twins, twins_table
from gsfeatloc_ros.common.geometry import pose_from_numbers, quaternion_from_matrix
from gsfeatloc_ros.evaluate.scene import load_scene
from gsfeatloc_ros.localize.settings import RendererSettings
from gsfeatloc_ros.maps import load_map
from gsfeatloc_ros.maps.ply import write_ply
from gsfeatloc_ros.match import DEFAULT_MATCHER, MATCHERS
from gsfeatloc_ros.render import DEVICES
from gsfeatloc_ros.simulate.two_rooms import VIEWS, two_rooms
from gsfeatloc_ros.tools.options import add_old_name, check_outputs, number, picture_size
from gsfeatloc_ros.tools.status import run_tool


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status: 0, or 2 where something cannot be used."""
    options = make_parser().parse_args(arguments)

    def run() -> int:
        check_outputs(getattr(options, "out", None), getattr(options, "json", None))
        options.run(options)
        return 0

    return run_tool("benchmark", run)


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog="gsfeatloc benchmark", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    device = argparse.ArgumentParser(add_help=False)
    device.add_argument("--device", choices=DEVICES, default="auto", help="to render on (default: %(default)s)")
    device.add_argument("--threads", type=number(int, 0), default=0, help="CPU threads; 0 for one per core")
    file = argparse.ArgumentParser(add_help=False)
    file.add_argument("--json", type=Path, metavar="FILE", help="write the figures here as well")

    frames = argparse.ArgumentParser(add_help=False)
    source = frames.add_mutually_exclusive_group(required=True)
    source.add_argument("--map", type=Path, help="map file: the same frame again and again")
    source.add_argument(
        "--scene", type=Path, help="folder with a map and photos: a frame at the pose of each test photo"
    )
    frames.add_argument(
        "--size", type=picture_size, default=(640, 480), metavar="WxH", help="of the frames (default: 640x480)"
    )
    frames.add_argument(
        "--pose",
        type=number(float, -math.inf),
        nargs=7,
        metavar=("X", "Y", "Z", "QX", "QY", "QZ", "QW"),
        help="of the camera (z forward) in the map (default: the whole map in view)",
    )
    frames.add_argument(
        "--frames", type=number(int, 1), default=20, help="measured at that pose (default: %(default)s)"
    )

    render = commands.add_parser(
        "render", parents=[frames, device, file], help="time of a frame, and of loading the map of --map"
    )
    render.set_defaults(run=_render)

    opensplat = commands.add_parser(
        "opensplat", parents=[frames, file], help="time of a frame on the CPU against OpenSplat's, in turns"
    )
    opensplat.add_argument("--checkout", type=Path, required=True, help="of OpenSplat's sources, which are built")
    opensplat.add_argument("--threads", type=number(int, 0), default=0, help="CPU threads; 0 for one per core")
    opensplat.set_defaults(run=_opensplat)

    query = commands.add_parser("query", parents=[device, file], help="time of a localization, by stage")
    query.add_argument("--scene", type=Path, required=True, help="folder with a map and photos")
    query.add_argument(
        "--matcher", choices=MATCHERS, default=DEFAULT_MATCHER, help="of features (default: %(default)s)"
    )
    query.add_argument(
        "--sigma",
        type=number(float, 0),
        default=1.0,
        help="scale of the priors' errors; 1 as in the paper (default: %(default)s)",
    )
    query.set_defaults(run=_query)

    track = commands.add_parser(
        "track", parents=[device, file], help="time of a localization, by stage, whose prior is good: small motion"
    )
    track.add_argument("--scene", type=Path, required=True, help="folder with a map and photos")
    track.add_argument(
        "--frames", type=number(int, 1), default=60, help="along the simulated path (default: %(default)s)"
    )
    track.set_defaults(run=_track)

    synthetic = commands.add_parser("synthetic", help="make a map of two rooms to measure on")
    synthetic.add_argument(
        "--gaussians", type=number(int, 1), default=1_000_000, help="their number (default: %(default)s)"
    )
    synthetic.add_argument("--seed", type=number(int, 0), default=0, help="another one gives another map")
    synthetic.add_argument("--out", type=Path, required=True, metavar="FILE.ply", help="the map")
    synthetic.set_defaults(run=_synthetic)

    scaling = commands.add_parser("scaling", parents=[file], help="ms against Gaussians, pixels and threads, as a plot")
    scaling.add_argument("--out", type=Path, required=True, metavar="FILE.png", help="the plot")
    max_gaussians = scaling.add_argument(
        "--max-gaussians",
        type=number(int, COUNTS[0]),
        default=COUNTS[-1],
        help="of the largest map; 5 million take 6 GB (default: %(default)s)",
    )
    add_old_name(scaling, max_gaussians, "--most")
    scaling.set_defaults(run=_scaling)

    index = commands.add_parser("index", parents=[file], help="seconds, size and query time against views, as a plot")
    index.add_argument("--out", type=Path, required=True, metavar="FILE.png", help="the plot")
    index.add_argument(
        "--max-views",
        type=number(int, index_scaling.COUNTS[0]),
        default=index_scaling.COUNTS[-1],
        help="of the largest index; 50,000 take 4 GB (default: %(default)s)",
    )
    index.set_defaults(run=_index)

    twins = commands.add_parser("twins", parents=[file], help="photos of one of two rooms that are nearly alike")
    twins.add_argument(
        "--share",
        type=_shares,
        default=[0.0, 0.02],
        metavar="LIST",
        help="of the second room's surfaces that other pictures cover, each in a map of its own (default: 0,0.02)",
    )
    twins.add_argument("--photos", type=number(int, 1), default=200, help="in each map (default: %(default)s)")
    twins.add_argument(
        "--seed", type=number(int, 0), default=0, help="another one gives other rooms, photos and indices"
    )
    twins.set_defaults(run=_twins)

    planar = commands.add_parser(
        "planar", parents=[file], help="photos of a robot on the floor, by views anywhere and by views on its plane"
    )
    planar.add_argument("--views", type=_counts, default=[12, 24, 48], metavar="LIST", help="(default: 12,24,48)")
    planar.add_argument("--photos", type=number(int, 1), default=40, help="(default: %(default)s)")
    planar.add_argument(
        "--seed", type=number(int, 0), default=0, help="another one gives another room, photos and indices"
    )
    planar.set_defaults(run=_planar)

    building = commands.add_parser("building", parents=[file], help="memory, starts, frames, queries of large maps")
    building.add_argument(
        "--rooms",
        type=_counts,
        default=[2, 10, 40, 100],
        metavar="LIST",
        help="of the buildings, of 500,000 Gaussians each (default: 2,10,40,100)",
    )
    building.add_argument("--folder", type=Path, required=True, help="of the maps; 100 rooms take 7 GB, 13 at first")
    building.add_argument("--sh-degree", type=int, choices=range(4), default=0, help="(default: %(default)s)")
    building.set_defaults(run=_building)

    commands.add_parser("pnp", help="PoseLib against OpenCV's USAC on simulated matches").set_defaults(
        run=lambda options: measure_pnp()
    )
    return parser


def _render(options: argparse.Namespace) -> None:
    _check_frames(options)
    settings = RendererSettings(device=options.device, threads=options.threads)
    if options.scene:
        report = measure_scene(options.scene, options.size, settings)
    else:
        pose = pose_from_numbers(options.pose) if options.pose else None
        report = measure_map(options.map, options.size, pose, options.frames, settings)
    print_frames(report)
    _write(options.json, report | {"device": options.device, "threads": options.threads})


def _opensplat(options: argparse.Namespace) -> None:
    # Imported here: torch takes a second, and the other commands do without.
    from gsfeatloc_ros.benchmark.opensplat import measure_against_opensplat, print_against_opensplat

    _check_frames(options)
    if options.scene:
        scene = load_scene(options.scene)
        gaussian_map, camera = load_map(scene.map_path), scene.camera.scaled(*options.size)
        poses = [photo.T_map_camera for photo in scene.photos]
    else:
        gaussian_map, camera = load_map(options.map), pinhole(options.size)
        poses = [pose_from_numbers(options.pose) if options.pose else view_of_all(gaussian_map)] * options.frames
    report = measure_against_opensplat(options.checkout, gaussian_map, camera, poses, options.threads)
    print_against_opensplat(report)
    _write(options.json, report)


def _check_frames(options: argparse.Namespace) -> None:
    if options.scene and options.pose:
        raise ValueError("--pose is for --map; the frames of a scene are at the poses of its photos")


def _query(options: argparse.Namespace) -> None:
    report = measure_queries(options.scene, options.matcher, options.sigma, options.device, options.threads)
    print_queries(report)
    _write(options.json, report | {"device": options.device, "threads": options.threads})


def _track(options: argparse.Namespace) -> None:
    settings = RendererSettings(device=options.device, threads=options.threads)
    report = measure_tracking(options.scene, options.frames, settings)
    print_tracking(report)
    _write(options.json, report | {"device": options.device, "threads": options.threads})


def _synthetic(options: argparse.Namespace) -> None:
    write_ply(options.out, two_rooms(options.gaussians, options.seed))
    print(f"{options.out}: {options.gaussians} Gaussians. To measure on it:")
    for name, pose in VIEWS.items():
        numbers = [*pose[:3, 3], *quaternion_from_matrix(pose[:3, :3])]
        words = " ".join(f"{number:.4g}" for number in numbers)
        print(f"  {name:10}  gsfeatloc benchmark render --map {options.out} --pose {words}")


def _scaling(options: argparse.Namespace) -> None:
    counts = [count for count in COUNTS if count <= options.max_gaussians]
    rows = measure_scaling(counts)
    draw_scaling(rows, options.out)
    _write(options.json, {"rows": rows})


def _index(options: argparse.Namespace) -> None:
    counts = [count for count in index_scaling.COUNTS if count <= options.max_views]
    rows = index_scaling.measure_index(counts)
    index_scaling.draw_index(rows, options.out)
    _write(options.json, {"rows": rows})


def _twins(options: argparse.Namespace) -> None:
    rows = measure_twins(options.share, options.photos, options.seed)
    print(twins_table(rows))
    _write(options.json, {"rows": rows})


def _planar(options: argparse.Namespace) -> None:
    _write(options.json, {"rows": measure_planar(options.views, options.photos, options.seed)})


def _building(options: argparse.Namespace) -> None:
    rows = measure_buildings(options.rooms, options.folder, options.sh_degree)
    _write(options.json, {"rows": rows})


def _write(path: Path | None, report: dict[str, Any]) -> None:
    if path:
        path.write_text(json.dumps({"machine": machine()} | report, indent=1) + "\n")


def _counts(text: str) -> list[float]:
    return [number(int, 1)(part) for part in text.split(",")]


def _shares(text: str) -> list[float]:
    shares = [number(float, 0.0)(part) for part in text.split(",")]
    if max(shares) > 1:
        raise argparse.ArgumentTypeError(f"{text} is not a list of numbers from 0 to 1")
    return shares


if __name__ == "__main__":
    sys.exit(main())
