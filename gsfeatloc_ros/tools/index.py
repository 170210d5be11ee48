"""Make the index of a map's views ahead of use, by which images without a prior are found.

    gsfeatloc index room.ply
    gsfeatloc index room.ply --poses SCENE --views 480 --matcher xfeat --out room.index

Without --out it goes where the node looks for it: beside the map, or into the user's cache. The node, which makes one
by itself where there is none, takes it as long as map, frame and matcher are those that it was made with.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from tqdm import tqdm

from gsfeatloc_ros.common.parameter import Parameter, parameters_of
from gsfeatloc_ros.evaluate.scene import load_poses
from gsfeatloc_ros.index import IndexOptions, ViewIndex, build_index
from gsfeatloc_ros.index.storage import index_path, save_index
from gsfeatloc_ros.localize.engine import load_matcher, load_renderer
from gsfeatloc_ros.localize.map_index import index_key
from gsfeatloc_ros.localize.settings import MatcherSettings, RendererSettings
from gsfeatloc_ros.maps import Similarity
from gsfeatloc_ros.match import MATCHERS
from gsfeatloc_ros.render import DEVICES, Renderer
from gsfeatloc_ros.tools.options import add_map_options, check_outputs, map_settings, number, print_reading, value_of
from gsfeatloc_ros.tools.status import run_tool


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status.

    It is 0 when the index was written, 2 when something cannot be used and 130 when the user interrupted it.
    """
    options = make_parser().parse_args(arguments)
    return run_tool("index", lambda: _index(options))


def _index(options: argparse.Namespace) -> int:
    start = time.perf_counter()
    path, index = _make(options)
    size, seconds = path.stat().st_size / 1e6, time.perf_counter() - start
    print(f"{path}: {len(index)} views, {len(index.codes)} features, {size:.1f} MB, {seconds:.1f} s")
    return 0


def _make(options: argparse.Namespace) -> tuple[Path, ViewIndex]:
    """Make the index that the options ask for, and write it; return where it is."""
    check_outputs(options.out)
    map_ = map_settings(options).resolved()
    key = index_key(map_.path, map_, matcher_settings(options), index_settings(options))
    path = options.out or index_path(map_.path)
    poses = training_poses(options, map_.alignment())
    renderer = load_renderer(map_, RendererSettings(options.device, options.threads))
    print_reading("index", renderer)
    index = make_index(options, renderer, poses)
    save_index(path, index, key)
    return path, index


def matcher_settings(options: argparse.Namespace) -> MatcherSettings:
    """Return the features that options of `add_index_options` name."""
    return MatcherSettings(options.matcher, options.weights)


def index_settings(options: argparse.Namespace) -> IndexOptions:
    """Return how options of `add_index_options` say that an index is made."""
    return IndexOptions(**{option.name: getattr(options, option.name) for option in _options()})


def training_poses(options: argparse.Namespace, placed: Similarity) -> np.ndarray | None:
    """Return the poses (N, 4, 4) T_map_camera that options of `add_index_options` name; None where they name none.

    Args:
        options: the scene's poses are in the frame of the map's file.
        placed: where that lies in the map frame.
    """
    if not options.poses:
        return None
    return np.array([placed.transform_pose(pose) for pose in load_poses(options.poses)])


def make_index(options: argparse.Namespace, renderer: Renderer, poses: np.ndarray | None) -> ViewIndex:
    """Make the index that options of `add_index_options` ask for, of a renderer's map, and show how far it is."""
    features = load_matcher(matcher_settings(options), renderer.device)
    with tqdm(desc="views", unit="view", disable=None) as bar:

        def progress(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        return build_index(renderer, features, index_settings(options), progress, poses=poses)


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog="gsfeatloc index", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("map", type=Path, metavar="MAP", help="the Gaussian Splatting map")
    add_index_options(parser)
    parser.add_argument("--out", type=Path, metavar="FILE", help="the index (default: where the node looks for it)")
    add_map_options(parser)
    return parser


def add_index_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of how an index is made, for `make_index`."""
    matcher = MatcherSettings()
    parser.add_argument(
        "--poses",
        type=Path,
        metavar="SCENE",
        help="poses that the map's photos were taken at, in the frame of its file, which are chosen from first: the "
        "folder of a scene, as for evaluate, or a transforms.json",
    )
    for option in _options():
        parser.add_argument(
            "--" + option.name.replace("_", "-"),
            type=value_of(option),
            default=option.default,
            metavar=option.name.rpartition("_")[2].upper(),
            help=f"{option.description} (default: %(default)s)",
        )
    parser.add_argument("--matcher", choices=sorted(MATCHERS), default=matcher.name, help="default: %(default)s")
    parser.add_argument("--weights", default="", metavar="PATH", help="of a learned matcher, as matcher.weights")
    parser.add_argument("--device", choices=DEVICES, default="auto", help="to render on (default: %(default)s)")
    parser.add_argument("--threads", type=number(int, 0), default=0, help="CPU threads; 0 for one per core")


def _options() -> list[Parameter]:
    """Return the node's parameters index.* that are about how an index is made: not whether, nor where it is kept."""
    return [option for option in parameters_of(IndexOptions) if option.name not in ("build", "path")]


if __name__ == "__main__":
    sys.exit(main())
