"""Fly through a map in the browser: look at answers in it, send priors, and set its floor and scale.

    gsfeatloc view room.ply
    gsfeatloc view room.ply --answers replayed --bag BAG --image /camera/image_raw --camera-info /camera/camera_info
    gsfeatloc view room.ply --live localizer
    gsfeatloc view room.ply --out map.yaml

It prints the address of a page. --answers shows what replay wrote into a folder, with --bag the photos beside the map
too; --live what a running node says, and sends it priors. The panel Frame writes the parameters map.* to the file of
--out, as gsfeatloc align does. The page serves this machine alone; from another, go through ssh -L 8080:localhost:8080.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING

from gsfeatloc_ros.evaluate.extras import import_extra
from gsfeatloc_ros.localize.settings import MapSettings
from gsfeatloc_ros.maps import load_map
from gsfeatloc_ros.render import DEVICES, create_renderer
from gsfeatloc_ros.replay.bag import Role
from gsfeatloc_ros.ros_io.calibration_file import read_calibration
from gsfeatloc_ros.ros_io.parameter_file import read_parameter_file
from gsfeatloc_ros.ros_io.settings import Settings
from gsfeatloc_ros.tools.options import add_map_options, check_outputs, given_map, number, print_reading
from gsfeatloc_ros.tools.status import run_tool
from gsfeatloc_ros.view.attempts import read_replay
from gsfeatloc_ros.view.recorded import read_recording
from gsfeatloc_ros.view.store import Store

if TYPE_CHECKING:
    from gsfeatloc_ros.client.live import LiveNode

_LOOPBACK = "127.0.0.1"
_MAX_PORT = 65535
# Browsers draw so many well; each takes 32 bytes on the way there.
_GAUSSIANS = 500_000
# Seconds between two looks at what came.
_PERIOD = 0.3


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status: 130 once the user ended it, 2 where something cannot be used."""
    parser = make_parser()
    options = parser.parse_args(arguments)
    if options.bag and not (options.answers and options.image):
        parser.error("--bag is of --answers, and needs --image")
    if options.live and options.answers:
        parser.error("--live and --answers: one of them")
    return run_tool("view", lambda: _view(options), "ended")


def _view(options: argparse.Namespace) -> int:
    import_extra("viser")
    from gsfeatloc_ros.view.page import Page, PageOptions
    from gsfeatloc_ros.view.server import PageServer, check_host

    check_host(options.host)
    check_outputs(options.out)
    store, map_ = Store(), _map(options)
    if options.answers:
        _read_answers(options, store)
    gaussian_map = load_map(map_.path, map_.alignment(), map_.reading)
    renderer = create_renderer(gaussian_map, options.device, options.threads)
    print_reading("view", renderer)
    with ExitStack() as stack:
        live = None
        if options.live:
            live = stack.enter_context(closing(_live(options, map_, store)))
        server = PageServer(options.host, options.port)
        stack.callback(server.stop)
        page = Page(server, map_, gaussian_map, renderer, store)
        page.build(PageOptions(options.gaussians, options.out), live)
        page.update()
        if options.host != _LOOPBACK:
            print(f"view: whoever reaches {options.host} can use the page: it has no password", file=sys.stderr)
        print(f"http://{options.host}:{server.get_port()}", flush=True)
        while True:
            time.sleep(_PERIOD)
            page.update()


def _map(options: argparse.Namespace) -> MapSettings:
    """Return the map, and where it lies: by a parameter file, and by options where these are not the default."""
    values = read_parameter_file(options.params_file) if options.params_file else {}
    return Settings.checked(values | given_map(options)).map.resolved()


def _read_answers(options: argparse.Namespace, store: Store) -> None:
    """Fill a store with what replay wrote, and with the photos and priors of its bag."""
    attempts = read_replay(options.answers)
    for attempt in attempts:
        store.add(attempt)
    if options.bag:
        named = {Role.IMAGE: options.image, Role.CAMERA_INFO: options.camera_info, Role.PRIOR: options.prior}
        topics = {role: [topic] for role, topic in named.items() if topic}
        calibration = read_calibration(options.calibration) if options.calibration else None
        recording = read_recording(options.bag, topics, calibration, {attempt.stamp for attempt in attempts})
        store.add_recording(recording.photos, recording.priors)


def _live(options: argparse.Namespace, map_: MapSettings, store: Store) -> LiveNode:
    try:
        from gsfeatloc_ros.client.live import LiveNode
    except ModuleNotFoundError as error:
        raise RuntimeError(f"--live needs ROS 2, and {error.name} is missing: source its setup.bash") from error
    return LiveNode(options.live, map_.frame_id, store, ["--ros-args", *options.ros_args])


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog="gsfeatloc view", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("map", type=Path, metavar="MAP", help="the Gaussian Splatting map")
    parser.add_argument("--answers", type=Path, metavar="DIR", help="what replay wrote: the folder of its --out")
    parser.add_argument("--bag", type=Path, help="that was replayed: shows its photos")
    parser.add_argument("--image", metavar="TOPIC", help="of the bag")
    parser.add_argument("--camera-info", metavar="TOPIC", help="of the bag")
    parser.add_argument("--calibration", type=Path, metavar="FILE", help="of a bag without camera_info")
    parser.add_argument("--prior", metavar="TOPIC", help="of the bag, in the map's frame")
    parser.add_argument(
        "--live", nargs="?", const="localizer", metavar="NODE", help="a running localizer (default: localizer)"
    )
    parser.add_argument("--out", type=Path, metavar="FILE", help="parameter file that the panel Frame may write")
    parser.add_argument("--params-file", type=Path, metavar="FILE", help="where the map lies, as gsfeatloc align wrote")
    parser.add_argument(
        "--gaussians",
        type=number(int, 1),
        default=_GAUSSIANS,
        metavar="N",
        help="drawn at most, of more a sample, larger (default: %(default)s)",
    )
    parser.add_argument(
        "--port", type=number(int, 0, _MAX_PORT), default=8080, help="or the next free one (default: %(default)s)"
    )
    parser.add_argument(
        "--host", default=_LOOPBACK, help="address to listen on; there is no password (default: %(default)s)"
    )
    parser.add_argument("--device", choices=DEVICES, default="auto", help="to render on (default: %(default)s)")
    parser.add_argument("--threads", type=number(int, 0), default=0, help="CPU threads; 0 for one per core")
    add_map_options(parser)
    parser.add_argument(
        "--ros-args", nargs=argparse.REMAINDER, default=[], help="of --live, at the end: remappings, as -r pose:=/there"
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
