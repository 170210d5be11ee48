"""Queries that went worst, with pictures that show why."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np

from gsfeatloc_ros.common.arrays import to_host
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import invert, transform
from gsfeatloc_ros.evaluate.metrics import QueryResult
from gsfeatloc_ros.evaluate.pictures import mark_matches, side_by_side
from gsfeatloc_ros.evaluate.run import Task, open_renderer, open_scene, trace
from gsfeatloc_ros.evaluate.tables import RunResults, condition_words
from gsfeatloc_ros.match.base import Matches

_MAX_QUERIES = 6
_MIN_QUERIES = 3  # are shown even when all is well
_MAX_PICTURE_WIDTH = 420  # pixels of each picture
_JPEG_QUALITY = 85
_NO_VIEW_LEVEL = 235  # grey
# Depths that differ by less than this share are those of the same surface.
_MAX_DEPTH_DIFFERENCE = 0.1

# Depth (H, W) of a render, NaN where there is none, and its pose (4, 4) T_map_camera.
_View: TypeAlias = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class WorstQuery:
    """A query to look at.

    Attributes:
        task, result: what was asked and what came out.
        picture: the photo without distortion, the map at the prior, and the last view of the map that was compared with
            the photo (of the published recipe, the map at its answer), as a data URL of a JPEG; inliers have rings of
            one colour in the first and the last.
        seen_at_prior: share of what the photo shows of the map that is in view from the prior; NaN where it shows
            nothing of it.
    """

    task: Task
    result: QueryResult
    picture: str
    seen_at_prior: float

    @property
    def condition(self) -> str:
        """What was done to the photo and the map in words; "" for nothing."""
        return ", ".join(condition_words(self.task.run))


def worst_queries(runs: Sequence[RunResults]) -> list[WorstQuery]:
    """Localize the worst queries of some runs again: wrong answers first, then no answers, then the largest errors.

    That a photo which is not of the scene has no answer is as it should be.
    """
    pairs = [pair for run in runs for pair in zip(run.tasks, run.results, strict=True)]
    pairs = [(task, result) for task, result in pairs if result.answered or not task.run.negative]
    pairs.sort(key=lambda pair: (("wrong", "none", "right").index(pair[1].verdict), -pair[1].relative_error))
    bad = sum(result.verdict != "right" for _, result in pairs)
    return [_look(task, result) for task, result in pairs[: min(_MAX_QUERIES, max(_MIN_QUERIES, bad))]]


def _look(task: Task, result: QueryResult) -> WorstQuery:
    run, prior = task.run, task.prior.T_map_camera
    truth = open_scene(run.scene, run.map_path, task.version).photos[task.prior.photo].T_map_camera
    renderer = open_renderer(task.drawn_map)
    traced = trace(task)
    camera = traced.photo.camera
    prior_render = renderer.render(camera, prior)
    last_render = traced.render
    if last_render is None and traced.estimate.T_map_camera is not None:
        last_render = renderer.render(camera, traced.estimate.T_map_camera)
    size = camera.limited(_MAX_PICTURE_WIDTH)
    left, middle = (_resized(picture, size) for picture in (traced.photo.image, prior_render.image()))
    right = np.full_like(left, _NO_VIEW_LEVEL)
    if last_render is not None:
        matches = _scaled(traced.correspondences, camera, size)
        left, right = mark_matches(left, _resized(last_render.image(), size), matches)
    seen = float("nan")
    if not run.negative:
        views = [(renderer.render(camera, truth), truth), (prior_render, prior)]
        seen = _share_in_view(camera, *((to_host(render.depth), pose) for render, pose in views))
    return WorstQuery(task, result, _data_url(side_by_side([left, middle, right])), seen)


def _scaled(matches: Matches, camera: Camera, smaller: Camera) -> Matches:
    """Return matches of images of one camera's size in images of another's."""
    scale = np.array([smaller.width / camera.width, smaller.height / camera.height])
    a, b = ((pixels + 0.5) * scale - 0.5 for pixels in (matches.a, matches.b))
    return Matches(a, b, matches.scores)


def _share_in_view(camera: Camera, here: _View, there: _View) -> float:
    """Return the share of the surfaces in one view that another shows too; NaN if there are none."""
    depth_here, T_map_here = here
    depth_there, T_map_there = there
    rows, columns = np.nonzero(np.isfinite(depth_here))
    rays = camera.rays(np.column_stack([columns, rows]))
    points = transform(invert(T_map_there) @ T_map_here, rays * depth_here[rows, columns, None].astype(np.float64))
    if len(points) == 0:
        return float("nan")
    total = len(points)
    points = points[points[:, 2] > 0]
    pixels = np.rint(camera.project(points))
    inside = ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(axis=1)
    columns, rows = pixels[inside].astype(int).T
    depth = points[inside, 2]
    return float(np.sum(np.abs(depth_there[rows, columns] - depth) < _MAX_DEPTH_DIFFERENCE * depth)) / total


def _resized(image: np.ndarray, camera: Camera) -> np.ndarray:
    return cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)


def _data_url(image: np.ndarray) -> str:
    """Return an RGB image (H, W, 3) uint8 as the address of a JPEG that holds itself."""
    encoded = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1]
    return "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode()
