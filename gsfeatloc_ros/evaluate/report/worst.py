"""The queries that went worst, with pictures that show why."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import invert, transform
from gsfeatloc_ros.evaluate.metrics import QueryResult
from gsfeatloc_ros.evaluate.pictures import mark_matches, side_by_side
from gsfeatloc_ros.evaluate.run import Task, localize, open_renderer, open_scene
from gsfeatloc_ros.evaluate.tables import RunResults
from gsfeatloc_ros.localize.estimate import Estimate
from gsfeatloc_ros.match.base import Matches
from gsfeatloc_ros.render import Render, Renderer

_MOST = 6
_LEAST = 3  # are shown even when all is well
_WIDTH = 420  # pixels of each picture
_JPEG_QUALITY = 85
_NO_VIEW = 235  # grey level
# Depths that differ by less than this share are those of the same surface.
_SAME_DEPTH = 0.1


@dataclass(frozen=True)
class WorstQuery:
    """A query to look at.

    Attributes:
        task, result: what was asked and what came out.
        picture: the photo without distortion, the map at the prior, and the last view of the map that was compared with
            the photo, as a data URL of a JPEG; inliers have rings of one colour in the first and the last.
        seen_at_prior: share of what the photo shows of the map that is in view from the prior.
    """

    task: Task
    result: QueryResult
    picture: str
    seen_at_prior: float


def worst_queries(runs: Sequence[RunResults]) -> list[WorstQuery]:
    """Look again at the queries of some runs that went worst: wrong answers, no answers, then the largest errors."""
    pairs = [pair for run in runs for pair in zip(run.tasks, run.results, strict=True)]
    pairs.sort(key=lambda pair: (("wrong", "none", "right").index(pair[1].verdict), -pair[1].relative_error))
    bad = sum(result.verdict != "right" for _, result in pairs)
    return [_look(task, result) for task, result in pairs[: min(_MOST, max(_LEAST, bad))]]


def _look(task: Task, result: QueryResult) -> WorstQuery:
    scene = open_scene(task.run.scene, task.run.map_path, task.version)
    renderer = open_renderer(scene.map_path, scene.background, task.version)
    photo = scene.photos[task.prior.photo]
    localized = photo.camera.limited(task.run.max_width)
    estimate = localize(task)[1]
    prior_render = renderer.render(localized, task.prior.T_map_camera)
    truth_render = renderer.render(localized, photo.T_map_camera)
    view = _last_view(renderer, localized, estimate)
    size = localized.limited(_WIDTH)
    image = photo.camera.undistort_image(scene.read_photo(photo))
    left, middle = (_resized(picture, size) for picture in (image, prior_render.image()))
    right = np.full_like(left, _NO_VIEW)
    if view is not None:
        matches = _scaled(estimate.correspondences, localized, size)
        left, right = mark_matches(left, _resized(view.image(), size), matches)
    strip = side_by_side([left, middle, right])
    seen = _share_in_view(localized, truth_render, photo.T_map_camera, prior_render, task.prior.T_map_camera)
    return WorstQuery(task, result, _data_url(strip), seen)


def _last_view(renderer: Renderer, camera: Camera, estimate: Estimate) -> Render | None:
    if estimate.last_render is not None or estimate.T_map_camera is None:
        return estimate.last_render
    return renderer.render(camera, estimate.T_map_camera)


def _scaled(matches: Matches | None, camera: Camera, smaller: Camera) -> Matches:
    """Matches of images of one camera's size, none for None, in images of another's."""
    if matches is None:
        return Matches(np.empty((0, 2)), np.empty((0, 2)), np.empty(0))
    scale = np.array([smaller.width / camera.width, smaller.height / camera.height])
    a, b = ((pixels + 0.5) * scale - 0.5 for pixels in (matches.a, matches.b))
    return Matches(a, b, matches.scores)


def _share_in_view(
    camera: Camera, here: Render, T_map_here: np.ndarray, there: Render, T_map_there: np.ndarray
) -> float:
    """Share of the surfaces in one view (from `T_map_here`) that another shows too; NaN if there are none."""
    rows, columns = np.nonzero(np.isfinite(here.depth))
    rays = camera.rays(np.column_stack([columns, rows]))
    points = transform(invert(T_map_there) @ T_map_here, rays * here.depth[rows, columns, None].astype(np.float64))
    if len(points) == 0:
        return float("nan")
    total = len(points)
    points = points[points[:, 2] > 0]
    pixels = np.rint(camera.project(points))
    inside = ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(axis=1)
    columns, rows = pixels[inside].astype(int).T
    depth = points[inside, 2]
    return float(np.sum(np.abs(there.depth[rows, columns] - depth) < _SAME_DEPTH * depth)) / total


def _resized(image: np.ndarray, camera: Camera) -> np.ndarray:
    return cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)


def _data_url(image: np.ndarray) -> str:
    """An RGB image (H, W, 3) uint8 as the address of a JPEG that holds itself."""
    encoded = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1]
    return "data:image/jpeg;base64," + base64.b64encode(encoded).decode()
