"""Scenes from folders, whatever kind of data set they hold, and the renderers of their maps."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsfeatloc_ros.evaluate import colmap, nerf_synthetic, nerfstudio
from gsfeatloc_ros.evaluate.dataset import PosedPhoto, Scene
from gsfeatloc_ros.evaluate.photo_file import photo_size, read_photo
from gsfeatloc_ros.localize.engine import load_renderer
from gsfeatloc_ros.localize.settings import MapSettings, RendererSettings
from gsfeatloc_ros.maps import GaussianMap, load_map
from gsfeatloc_ros.maps.files import iteration
from gsfeatloc_ros.render import DrawOptions, Renderer, create_renderer

# Of each kind, what its folder holds.
_KINDS = {
    "transforms.json": nerfstudio.load,
    "transforms_test.json": nerf_synthetic.load,
    "sparse": colmap.load,
}
_MAPS = ("map.ply", "point_cloud.ply", "point_cloud/iteration_*/point_cloud.ply")
# From the origin, in map units: what is computed of more overflows.
_MAX_DISTANCE = 1e9
_BLACK = (0.0, 0.0, 0.0)
_WHITE = (1.0, 1.0, 1.0)


def load_scene(folder: str | Path, map_path: str | Path | None = None) -> Scene:
    """Read a scene folder: nerfstudio's layout, NeRF-Synthetic's or a COLMAP model.

    Args:
        folder: holds `transforms.json`, `transforms_test.json` or COLMAP's `sparse`, and the photos.
        map_path: the map; None for the one in the folder: map.ply, point_cloud.ply or the last iteration of
            point_cloud/iteration_*/point_cloud.ply.

    Raises:
        ValueError: the folder is none of these, holds no map, lacks a photo, or its files are not right.
        RuntimeError: it is a COLMAP model and pycolmap is not installed.
    """
    folder = Path(folder).resolve()
    kind = next((name for name in _KINDS if (folder / name).exists()), None)
    if kind is None:
        raise ValueError(f"{folder}: holds none of {', '.join(_KINDS)}")
    photos, trajectory = _KINDS[kind](folder)
    distance = np.abs(trajectory[:, :3, 3]).max()
    if distance > _MAX_DISTANCE:
        raise ValueError(f"{folder}: a photo was taken {distance:g} units from the origin, at most {_MAX_DISTANCE:g}")
    if len({photo.name for photo in photos}) < len(photos):
        photos = [replace(photo, name=photo.path.relative_to(folder).as_posix()) for photo in photos]
    missing = [photo.name for photo in photos if not photo.path.is_file()]
    if missing:
        raise ValueError(
            f"{folder}: {len(missing)} of {len(photos)} test photos are missing, the first is {missing[0]}"
        )
    return Scene(
        name=folder.name,
        map_path=Path(map_path) if map_path else _find_map(folder),
        photos=tuple(_with_cameras_of_their_size(photos)),
        trajectory=trajectory,
        background=_WHITE if read_photo(photos[0].path).shape[2] == 4 else _BLACK,
    )


def load_poses(path: str | Path) -> np.ndarray:
    """Read the poses (F, 4, 4) of all frames of a scene folder, or of a transforms file, in the frame of its map.

    Raises:
        ValueError, RuntimeError: as load_scene.
    """
    path = Path(path)
    # The map does not matter.
    return nerfstudio.load_poses(path) if path.is_file() else load_scene(path, path).trajectory


def load_scene_renderer(
    scene: Scene, renderer: RendererSettings, dataparser_transforms: Path | None = None
) -> Renderer:
    """Make the renderer of a scene's map, on the background of its photos.

    The map is read anew: what is measured must not depend on a file that lies beside it.

    Args:
        scene: in whose frame the map is to lie.
        renderer: how it is drawn.
        dataparser_transforms: nerfstudio's file, of a map that lies in the frame that nerfstudio trained it in.

    Raises:
        ValueError, OSError, RuntimeError: the settings or the map cannot be used; the message says why.
    """
    return load_renderer(_map_of(scene, dataparser_transforms), renderer, scene.background)


def load_degraded_renderer(
    scene: Scene,
    renderer: RendererSettings,
    degrade: Callable[[GaussianMap], GaussianMap],
    dataparser_transforms: Path | None = None,
) -> Renderer:
    """Make the renderer of what `degrade` makes of a scene's map; otherwise as `load_scene_renderer`."""
    options = DrawOptions(scene.background, renderer.sh_degree, renderer.resolution_scale)
    map_ = _map_of(scene, dataparser_transforms)
    return create_renderer(degrade(load_map(map_.path, map_.alignment())), renderer.device, renderer.threads, options)


def _map_of(scene: Scene, dataparser_transforms: Path | None) -> MapSettings:
    placed = str(dataparser_transforms or "")
    return MapSettings(path=str(scene.map_path), dataparser_transforms=placed, cache=False)


def _with_cameras_of_their_size(photos: Sequence[PosedPhoto]) -> Iterator[PosedPhoto]:
    """Yield the photos with their cameras scaled to their size: many scenes come with smaller copies of the photos.

    All photos of a folder that have cameras of the same size count as of the same size, that of the first.
    """
    sizes: dict[tuple[Path, int, int], tuple[int, int]] = {}
    for photo in photos:
        camera, kind = photo.camera, (photo.path.parent, photo.camera.width, photo.camera.height)
        if kind not in sizes:
            width, height = photo_size(photo.path)
            # The longer side says how much; the other may have been rounded.
            scale = max(width, height) / max(camera.width, camera.height)
            off = abs(width - scale * camera.width) + abs(height - scale * camera.height)
            sizes[kind] = (width, height) if off < 1 else (camera.width, camera.height)
        width, height = sizes[kind]
        fits = (width, height) == (camera.width, camera.height)
        yield photo if fits else replace(photo, camera=camera.scaled(width, height))


def _find_map(folder: Path) -> Path:
    for pattern in _MAPS:
        found = sorted(folder.glob(pattern), key=iteration)
        if found:
            return found[-1]
    raise ValueError(f"{folder}: holds no map ({', '.join(_MAPS)}): say which one to use (--map)")
