"""Draw a map from a pose, or a path of poses: picture, depth and coverage in files, or a video.

    gsfeatloc render room.ply --pose 0 0 1.5 -0.5 0.5 -0.5 0.5 --fov 70 --size 640x480 --out view
    gsfeatloc render room.ply --pose 0 0 1.5 -0.5 0.5 -0.5 0.5 --camera camera_info.yaml --out view
    gsfeatloc render room.ply --path answers.tum --fov 70 --size 640x480 --video answers.mp4

Poses are those of the camera (x right, y down, z forward) in the map's frame: x y z qx qy qz qw, with a stamp before
them in a line of a TUM file. --out writes PREFIX.png, PREFIX_depth.png of 16 bits (millimetres, if the map's unit is
the metre: --depth-scale; 0 where there is no depth), PREFIX_depth.npy in map units and PREFIX_alpha.png; of a path
PREFIX_0000.png and so on. What a camera's file says of distortion is left out: pictures are rectified.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path

from tqdm import tqdm

from gsfeatloc_ros.align.pose_files import read_tum
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import pose_from_numbers
from gsfeatloc_ros.localize.engine import load_renderer
from gsfeatloc_ros.localize.settings import RendererSettings
from gsfeatloc_ros.render import DEVICES
from gsfeatloc_ros.render.picture_files import write_pictures, written_video
from gsfeatloc_ros.ros_io.calibration import decode_camera
from gsfeatloc_ros.ros_io.calibration_file import read_calibration
from gsfeatloc_ros.tools.options import (
    add_map_options,
    check_outputs,
    map_settings,
    number,
    picture_size,
    print_reading,
)
from gsfeatloc_ros.tools.status import run_tool

# Millimetres of a metre.
_DEPTH_SCALE = 1000.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status: 0, or 2 where something cannot be used."""
    parser = make_parser()
    options = parser.parse_args(arguments)
    if not (options.out or options.video):
        parser.error("say where to: --out PREFIX, or --video FILE")
    if options.video and not options.path:
        parser.error("--video is of --path")
    if options.pose and len(options.pose) not in (7, 8):
        parser.error(f"--pose takes x y z qx qy qz qw, or a line of a TUM file, not {len(options.pose)} numbers")
    if options.fov and not options.size:
        parser.error("--fov needs --size")
    return run_tool("render", lambda: _render(options))


def _render(options: argparse.Namespace) -> int:
    # --out is the beginning of names.
    check_outputs(options.out and options.out.with_name(f"{options.out.name}.png"), options.video)
    camera = _camera(options)
    poses = [pose for _, pose in read_tum(options.path)] if options.path else [pose_from_numbers(options.pose[-7:])]
    renderer = load_renderer(map_settings(options), RendererSettings(options.device, options.threads))
    print_reading("render", renderer)
    size = (camera.width, camera.height)
    too_far = 0
    with written_video(options.video, options.rate, size) if options.video else nullcontext() as video:
        for count, pose in enumerate(tqdm(poses, unit="frame", disable=None, leave=False)):
            render = renderer.render(camera, pose)
            if video:
                video.add(render)
            if options.out:
                name = f"{options.out.name}_{count:04}" if options.path else options.out.name
                too_far += write_pictures(options.out.with_name(name), render, options.depth_scale)
    if too_far:
        print(f"render: {too_far} pixels are too far for 16 bits and 0: give a smaller --depth-scale", file=sys.stderr)
    print(f"{len(poses)} of {size[0]}x{size[1]}: {', '.join(map(str, filter(None, (options.out, options.video))))}")
    return 0


def _camera(options: argparse.Namespace) -> Camera:
    """Return the camera, without distortion."""
    if options.camera:
        camera = decode_camera(read_calibration(options.camera)).pinhole()
        return camera.scaled(*options.size) if options.size else camera
    width, height = options.size
    focal_length = 0.5 * width / math.tan(math.radians(0.5 * options.fov))
    return Camera.centred(width, height, focal_length)


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog="gsfeatloc render", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("map", type=Path, metavar="MAP", help="the Gaussian Splatting map")
    poses = parser.add_mutually_exclusive_group(required=True)
    poses.add_argument(
        "--pose", type=number(float, -math.inf), nargs="+", metavar="N", help="x y z qx qy qz qw of the camera"
    )
    poses.add_argument("--path", type=Path, metavar="POSES.tum", help="many: a TUM file, as replay writes")
    cameras = parser.add_mutually_exclusive_group(required=True)
    cameras.add_argument("--camera", type=Path, metavar="FILE", help="calibration, as camera_calibration writes it")
    cameras.add_argument(
        "--fov", type=number(float, 0.1, 170), metavar="DEG", help="horizontal field of view, with --size"
    )
    parser.add_argument(
        "--size", type=picture_size, metavar="WxH", help="of the pictures, pixels (default: the camera's)"
    )
    parser.add_argument("--out", type=Path, metavar="PREFIX", help="of the pictures' paths")
    parser.add_argument(
        "--depth-scale",
        type=number(float, 1e-6),
        default=_DEPTH_SCALE,
        metavar="S",
        help="levels of the depth picture in a map unit (default: %(default)g, millimetres of metres)",
    )
    parser.add_argument("--video", type=Path, metavar="FILE.mp4", help="of --path (MPEG-4 part 2)")
    parser.add_argument("--rate", type=number(float, 0.1), default=10.0, help="frames a second (default: %(default)g)")
    parser.add_argument("--device", choices=DEVICES, default="auto", help="to render on (default: %(default)s)")
    parser.add_argument("--threads", type=number(int, 0), default=0, help="CPU threads; 0 for one per core")
    add_map_options(parser)
    return parser


if __name__ == "__main__":
    sys.exit(main())
