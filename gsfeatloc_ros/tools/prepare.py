"""Put a map and all that a robot needs of it into one folder, which map.path takes.

    gsfeatloc prepare room.ply --align room.yaml --out room
    gsfeatloc prepare room.ply --poses SCENE --matcher xfeat --out room
    scp -r room robot:

The folder holds a copy of the map, where it lies in the robot's frame, the map prepared for rendering, the index of its
views, what gsfeatloc inspect says of it, and a manifest with sizes and checksums. What of it is there already and fits
is not made again: after an interruption, the same command goes on.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

from tqdm import tqdm

from gsfeatloc_ros.common.kernel_cache import can_write
from gsfeatloc_ros.common.replaced_file import replaced_file
from gsfeatloc_ros.common.safe_files import open_regular
from gsfeatloc_ros.index.storage import index_path
from gsfeatloc_ros.inspect.inspection import inspect_map
from gsfeatloc_ros.inspect.page import as_page
from gsfeatloc_ros.localize.engine import load_renderer
from gsfeatloc_ros.localize.map_index import index_key, load_or_make
from gsfeatloc_ros.localize.settings import MapSettings, RendererSettings
from gsfeatloc_ros.maps import MapError, look_through
from gsfeatloc_ros.maps.bundle import ALIGNMENT, INSPECTION, MAP_FOLDER, Bundle, map_in, read_bundle
from gsfeatloc_ros.maps.files import content_of, find_map, map_files
from gsfeatloc_ros.render.cache import SUFFIX
from gsfeatloc_ros.ros_io.parameter_file import read_parameter_file
from gsfeatloc_ros.ros_io.settings import Settings
from gsfeatloc_ros.tools.index import (
    add_index_options,
    index_settings,
    make_index,
    matcher_settings,
    training_poses,
)
from gsfeatloc_ros.tools.options import add_map_options, given_map, print_reading
from gsfeatloc_ros.tools.status import run_tool

_COPIED_AT_ONCE = 1 << 24


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status.

    It is 0 when the bundle is whole, 2 when something cannot be used and 130 when the user interrupted it.
    """
    options = make_parser().parse_args(arguments)
    return run_tool("prepare", lambda: _prepare(options), "interrupted: the same command goes on from here")


def _prepare(options: argparse.Namespace) -> int:
    start = time.perf_counter()
    given = _given(options)
    poses = training_poses(options, given.alignment())
    old = read_bundle(options.out)
    if old is None:
        look_through(given.path, lambda part: None, options=given.reading)  # what is no map is not copied
    bundle, sources = _plan(options, given)
    _copy(bundle, sources)
    map_ = replace(MapSettings(str(bundle.folder)).resolved(), cache=True)
    renderer = load_renderer(map_, RendererSettings(options.device, options.threads))
    print_reading("prepare", renderer)
    index_file = index_path(map_.path)
    key = index_key(map_.path, map_, matcher_settings(options), index_settings(options))
    index = load_or_make(index_file, key, lambda: make_index(options, renderer, poses))
    derived = [bundle.map.with_name(bundle.map.name + SUFFIX), index_file]
    if not options.skip_inspection:
        derived += _inspected(bundle, old, RendererSettings(options.device, options.threads))
    contents = {file.relative_to(bundle.folder).as_posix(): content_of(file) for file in derived}
    bundle = replace(bundle, derived=contents, made_by={**bundle.made_by, "views": len(index)})
    bundle.write()
    size = sum(content[0] for content in [*bundle.files.values(), *contents.values()])
    print(f"{bundle.folder}: {len(index)} views, {size / 1e6:.1f} MB, {time.perf_counter() - start:.1f} s")
    return 0


def _given(options: argparse.Namespace) -> MapSettings:
    """Return the map that the options name, how it is read and where it lies.

    Raises:
        ValueError: something of that cannot be used; the message says what.
    """
    values = read_parameter_file(options.align) if options.align else {}
    for name in values:
        if not name.startswith("map."):
            raise ValueError(f"{options.align}: {name} is not of a map: a bundle takes the parameters map.* alone")
    aligned = values.get("map.path")
    if aligned and os.path.exists(aligned) and not os.path.samefile(aligned, options.map):
        raise ValueError(f"{options.align}: is of another map, {aligned}, not of {options.map}")
    settings = Settings.checked(values | given_map(options)).resolved()
    replace(settings, index=index_settings(options)).check_plane()
    return settings.map


def _plan(options: argparse.Namespace, given: MapSettings) -> tuple[Bundle, dict[str, Path]]:
    """Write the manifest of the bundle, in which nothing else need be yet; return it, and what is copied whereto.

    With the manifest the folder is a bundle, and what an interruption leaves is told from what nobody made.
    """
    path = map_in(given.path)
    found = find_map(path)
    sources = {f"{MAP_FOLDER}/{file.relative_to(found.parent).as_posix()}": file for file in map_files(path)}
    if not sources:
        raise MapError(f"{path}: cannot be read: there is no such map")
    map_name = f"{MAP_FOLDER}/{found.name}"
    if options.align:
        sources[ALIGNMENT] = options.align
    made_by = {"gsfeatloc_ros": _version(), "map": Path(given.path).name, "matcher": options.matcher}
    contents = {name: content_of(file) for name, file in sources.items()}
    # As the index has it, which goes there too.
    folder = Path(os.path.abspath(options.out))
    bundle = Bundle(folder, map_name, contents, parameters=given.bundled(), made_by=made_by)
    _check_place(bundle)
    bundle.write()
    return bundle, sources


def _check_place(bundle: Bundle) -> None:
    """Raise ValueError where the folder is another's, or cannot be written; it is made if need be."""
    folder = bundle.folder
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder}: is a file: name another folder (--out)")
    old = read_bundle(folder)
    if old is None and folder.exists() and any(folder.iterdir()):
        raise ValueError(f"{folder}: is not empty, and no bundle: name another folder (--out)")
    if old is not None and old.map_content != bundle.map_content:
        raise ValueError(f"{folder}: is the bundle of another map, {old.map.name}: name another folder (--out)")
    if old is not None and old.parameters and not bundle.parameters:
        raise ValueError(f"{folder}: has an alignment, which would be lost: give it again (--align)")
    if not can_write(folder.absolute()):
        raise ValueError(f"{folder}: cannot be written: name another folder (--out)")


def _copy(bundle: Bundle, sources: dict[str, Path]) -> None:
    """Copy to the bundle what does not lie in it yet."""
    missing = {name: file for name, file in sources.items() if not _lies_there(bundle, name)}
    total = sum(bundle.files[name][0] for name in missing)
    with tqdm(desc="copy", unit="B", unit_scale=True, total=total, disable=None if missing else True) as bar:
        for name, file in missing.items():
            path = bundle.folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            with open_regular(file) as source, replaced_file(path) as stream:
                while data := source.read(_COPIED_AT_ONCE):
                    stream.write(data)
                    bar.update(len(data))


def _inspected(bundle: Bundle, old: Bundle | None, renderer: RendererSettings) -> list[Path]:
    """Inspect the map where it lies, unless that was done; return the files that say what was found.

    Args:
        bundle: whose map it is.
        old: what the manifest said before; None for none.
        renderer: how the map is drawn.
    """
    files = [bundle.folder / name for name in INSPECTION if not name.endswith(".html") or find_spec("jinja2")]
    # As a manifest says them: what was a tuple is a list there.
    now = read_bundle(bundle.folder)
    if old is not None and now is not None and old.parameters == now.parameters:
        made = replace(old, files=old.derived)
        if all(file.name in made.files and _lies_there(made, file.name) for file in files):
            return files
    map_ = replace(MapSettings(str(bundle.folder)).resolved(), path=str(bundle.map))
    with tqdm(desc="inspect", unit="view", disable=None) as bar:

        def progress(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        inspection = inspect_map(map_, renderer, progress=progress)
    contents = {".json": json.dumps(inspection.as_json(), indent=1, allow_nan=False) + "\n"}
    if len(files) > 1:
        contents[".html"] = as_page(inspection, f"gsfeatloc inspect {bundle.map.name}")
    for file in files:
        with replaced_file(file) as stream:
            stream.write(contents[file.suffix].encode())
    return files


def _lies_there(bundle: Bundle, name: str) -> bool:
    path, content = bundle.folder / name, bundle.files[name]
    return path.is_file() and path.stat().st_size == content[0] and content_of(path) == content


def _version() -> str:
    try:
        return version("gsfeatloc_ros")
    except PackageNotFoundError:  # run from its sources
        return "unknown"


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog="gsfeatloc prepare", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("map", type=Path, metavar="MAP", help="the Gaussian Splatting map")
    parser.add_argument("--out", type=Path, required=True, metavar="BUNDLE", help="the folder, which is made")
    parser.add_argument("--skip-inspection", action="store_true", help="do not look at what is in the map")
    parser.add_argument("--align", type=Path, metavar="FILE", help="where the map lies, as gsfeatloc align wrote it")
    add_index_options(parser)
    add_map_options(parser)
    return parser


if __name__ == "__main__":
    sys.exit(main())
