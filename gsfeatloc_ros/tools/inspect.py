"""Say what is in a map, and what of it looks wrong for localization.

    gsfeatloc inspect room.ply
    gsfeatloc inspect room.ply --html room.html --json room.json
    gsfeatloc inspect SCENE/map.ply --photos SCENE

It looks at the map from where an index of views would. With --photos it says how well the map predicts its own photos,
and whether it does better if read otherwise (map.antialiased, map.spz_axes). With --map-rotation and the like it looks
at the map as the node would have it, which tells whether these are right.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

from gsfeatloc_ros.evaluate.scene import load_scene
from gsfeatloc_ros.inspect.inspection import MAX_WIDTH, inspect_map
from gsfeatloc_ros.inspect.page import as_page
from gsfeatloc_ros.inspect.text import as_text
from gsfeatloc_ros.localize.settings import RendererSettings
from gsfeatloc_ros.render import DEVICES
from gsfeatloc_ros.tools.options import add_map_options, check_outputs, map_settings, number
from gsfeatloc_ros.tools.status import run_tool


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status: 0, or 2 where something cannot be used."""
    options = make_parser().parse_args(arguments)
    command = shlex.join(["gsfeatloc", "inspect", *(sys.argv[1:] if arguments is None else arguments)])
    return run_tool("inspect", lambda: _inspect(options, command))


def _inspect(options: argparse.Namespace, command: str) -> int:
    check_outputs(options.json, options.html)
    scene = load_scene(options.photos, options.map) if options.photos else None
    with tqdm(desc="views", unit="view", disable=None, leave=False) as bar:

        def progress(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        settings = RendererSettings(options.device, options.threads)
        inspection = inspect_map(map_settings(options), settings, scene, options.max_width, progress)
    print(as_text(inspection))
    if options.json:
        options.json.write_text(json.dumps(inspection.as_json(), indent=1, allow_nan=False) + "\n", encoding="utf-8")
    if options.html:
        options.html.write_text(as_page(inspection, command), encoding="utf-8")
    return 0


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog="gsfeatloc inspect", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("map", type=Path, metavar="MAP", help="the Gaussian Splatting map")
    parser.add_argument(
        "--photos",
        type=Path,
        metavar="SCENE",
        help="folder of its photos and their poses, as for evaluate",
    )
    parser.add_argument(
        "--max-width",
        type=number(int, 1),
        default=MAX_WIDTH,
        metavar="PIXELS",
        help="resize wider photos; best as wide as those that trained the map (default: %(default)s)",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write what was found here as well")
    parser.add_argument("--html", type=Path, metavar="FILE", help="write a page with views here (needs jinja2)")
    parser.add_argument("--device", choices=DEVICES, default="auto", help="to render on (default: %(default)s)")
    parser.add_argument("--threads", type=number(int, 0), default=0, help="CPU threads; 0 for one per core")
    add_map_options(parser)
    return parser


if __name__ == "__main__":
    sys.exit(main())
