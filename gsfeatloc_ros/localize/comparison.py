"""Photo and render at the estimate, compared both ways and cell by cell."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from gsfeatloc_ros.common.arrays import Array, to_host
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.doubt import fisher_z
from gsfeatloc_ros.common.local_structure import local_structure
from gsfeatloc_ros.common.photo import Photo
from gsfeatloc_ros.common.shrink import shrunk
from gsfeatloc_ros.localize.query import MatchedView, Query
from gsfeatloc_ros.pose.solve import Correspondences

# Cells across and down the photo.
CELLS = (16, 12)
# Pictures are compared at this focal length in pixels, or their own if that is shorter: finer detail splats do not
# draw, and what is compared is the same in a crop or a photo of another size.
_FOCAL_LENGTH = 300.0
# Standard deviation, in compared pixels, of the neighbourhood whose mean brightness and contrast are taken out.
_NEIGHBOURHOOD = 12.0
# Contrast (of 255) under which a neighbourhood says nothing: sky, a blank wall.
_MIN_CONTRAST = 2.0
# Pixels that are compared must be covered by the map, and seen by the lens.
_MIN_ALPHA = 0.9
_MIN_COVERED = 0.5
# Where it has less, the map shows nothing.
_MIN_ALPHA_OF_MAP = 0.5
# A cell is compared where so much of it is covered, and so much of that has contrast in one of the pictures.
_MIN_COVERED_SHARE = 0.3
_MIN_CONTRAST_SHARE = 0.5
# What is smoothed out of the mask of changes is narrower than so many compared pixels.
_BRUSH = 7
# What is wider than these, and not as in the map, was put there, or is gone: what lies beside it is judged without it.
# Narrower is where a map is soft, or the pose is wrong.
_MIN_WIDTH_OF_CHANGED = 21
# Where the local structures of photo and render correlate less, the photo shows something else than the map.
_MIN_CORRELATION = 0.5
# Views differ where their local structures are farther apart than this; cells of this many pixels across vote, if they
# hold so many that differ.
_MIN_DIFFERENCE = 0.5
_VOTING_CELL = 8
_MIN_DIFFERING_PIXELS = 6


@dataclass(frozen=True, eq=False)
class Comparison:
    """What photo and render have in common.

    Attributes:
        inlier_ratio: share of the photo's corners, of those that were found in the render and have a depth, that agree
            with the pose.
        render_inlier_ratio: the same of the render's corners in the photo; NaN where none was found.
        agreeing, disagreeing: (12, 16) number of corners of either in each cell of the photo.
        correlation: (12, 16) of the local structure of the two in each cell; NaN where there is nothing to compare.
        correlation_beside_changes: the same without the wider parts of the photo that are not as in the map.
        beyond_map: share of the photo's corners that are where the map shows nothing; NaN without any.
    """

    inlier_ratio: float
    render_inlier_ratio: float
    agreeing: np.ndarray
    disagreeing: np.ndarray
    correlation: np.ndarray
    correlation_beside_changes: np.ndarray
    beyond_map: float

    @property
    def explained_inlier_ratio(self) -> float:
        """Share of the corners of both that agrees in cells that look alike (Jeffreys' estimate); NaN without any.

        What covers the photo disagrees elsewhere; a place that is only nearly the same disagrees among what agrees.
        """
        alike = (self.agreeing > self.disagreeing) & (self.correlation_beside_changes >= _MIN_CORRELATION)
        agreeing, disagreeing = self.agreeing[alike].sum(), self.disagreeing[alike].sum()
        return float((agreeing + 0.5) / (agreeing + disagreeing + 1)) if agreeing else float("nan")

    @property
    def explained_correlation(self) -> float:
        """Mean correlation, by Fisher's z, of the cells in which most corners agree; NaN without any."""
        correlation = self.correlation_beside_changes
        values = correlation[(self.agreeing > self.disagreeing) & np.isfinite(correlation)]
        return float(np.tanh(fisher_z(values).mean())) if len(values) else float("nan")

    @property
    def changed(self) -> float:
        """Share of the compared cells in which the photo shows something else than the map; NaN for none."""
        compared = np.isfinite(self.correlation)
        return float(self._differs(self.correlation)[compared].mean()) if compared.any() else float("nan")

    @property
    def scattered(self) -> float:
        """Share of such cells beside the wider changes (Jeffreys' estimate); NaN where nothing is compared.

        What covers the photo lies together; a place that is only nearly the same differs here and there.
        """
        compared = np.isfinite(self.correlation_beside_changes)
        differing = self._differs(self.correlation_beside_changes)[compared].sum()
        return float((differing + 0.5) / (compared.sum() + 1)) if compared.any() else float("nan")

    def _differs(self, correlation: np.ndarray) -> np.ndarray:
        return (correlation < _MIN_CORRELATION) | (self.disagreeing > self.agreeing)


def compare(
    query: Query, view: MatchedView, errors: Callable[[Correspondences], np.ndarray], tolerance: float
) -> Comparison:
    """Compare a photo with the view from the estimate.

    Corners agree with it that are off by at most `tolerance` pixels; `errors` says by how many each of (M,) is.
    """
    camera = query.photo.camera
    with query.clock.stage("track"):
        back = query.tracker.track_back(view.image, lambda pixels: view.lift(pixels).valid)
        found = query.correspondences(back.a, view.lift(back.b), view.pose)
    with query.clock.stage("verify"):
        pair = _Pair.of(query.photo, view)
        structures = pair.structures(pair.covered)
        correlation = beside_changes = structures.correlation()
        if (changed := structures.changed(_MIN_WIDTH_OF_CHANGED)).any():
            beside_changes = pair.structures(pair.covered & ~changed).correlation()
    agrees, agrees_back = errors(view.found) <= tolerance, errors(found) <= tolerance
    pixels, all_agree = np.concatenate([view.found.pixels, found.pixels]), np.concatenate([agrees, agrees_back])
    return Comparison(
        inlier_ratio=float(agrees.mean()),
        render_inlier_ratio=float(agrees_back.mean()) if len(agrees_back) else float("nan"),
        agreeing=_count(pixels[all_agree], camera),
        disagreeing=_count(pixels[~all_agree], camera),
        correlation=correlation,
        correlation_beside_changes=beside_changes,
        beyond_map=_share_beyond(query.tracker.corners, view.render.alpha),
    )


def preference(photo: Photo, a: MatchedView, b: MatchedView) -> float:
    """Return by how many standard deviations of chance view `a` explains a photo better than `b`; 0 for no difference.

    Only where the two views differ they are compared with the photo, cell by cell; a pixel more or less in the estimate
    is no difference. Each cell has one vote.
    """
    of_a, of_b = (pair.structures(pair.covered) for pair in (_Pair.of(photo, view) for view in (a, b)))
    apart = of_a.counted & of_b.counted & (_least_difference(of_a.render, of_b.render) > _MIN_DIFFERENCE)
    lead = _least_difference(of_a.photo, of_b.render) - _least_difference(of_a.photo, of_a.render)
    height, width = (side // _VOTING_CELL * _VOTING_CELL for side in apart.shape)

    def total(values: np.ndarray) -> np.ndarray:
        blocks = values[:height, :width].reshape(height // _VOTING_CELL, _VOTING_CELL, -1, _VOTING_CELL)
        return blocks.sum(axis=(1, 3))

    votes = np.sign(total(np.where(apart, lead, 0.0)))[total(apart) >= _MIN_DIFFERING_PIXELS]
    return float(votes.sum() / np.sqrt(len(votes))) if len(votes) else 0.0


def _least_difference(fixed: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Return the least difference (H, W) of two pictures over shifts of the second by up to a pixel."""
    lowest, highest = cv2.erode(moved, np.ones((3, 3))), cv2.dilate(moved, np.ones((3, 3)))
    return np.maximum(np.maximum(lowest - fixed, fixed - highest), 0.0)


def changed_mask(photo: Photo, view: MatchedView) -> np.ndarray:
    """Return where the photo shows something else than the map: (H, W) uint8, 255 there and 0 elsewhere."""
    pair = _Pair.of(photo, view)
    changed = pair.structures(pair.covered).changed(_BRUSH).astype(np.uint8) * 255
    return cv2.resize(changed, (photo.camera.width, photo.camera.height), interpolation=cv2.INTER_NEAREST)


def _share_beyond(corners: np.ndarray, alpha: Array) -> float:
    """Return the share of corners (N, 2) that lie where a map's alpha (H, W) is small; NaN without any."""
    columns, rows = np.rint(corners).astype(int).T
    # Of a picture on a GPU only these pixels are fetched.
    return float((to_host(alpha[rows, columns]) < _MIN_ALPHA_OF_MAP).mean()) if len(corners) else float("nan")


def _count(pixels: np.ndarray, camera: Camera) -> np.ndarray:
    """Count pixels (M, 2) by the cells in which they lie: (12, 16)."""
    across, down = CELLS
    columns = np.clip((pixels[:, 0] + 0.5) * across // camera.width, 0, across - 1).astype(int)
    rows = np.clip((pixels[:, 1] + 0.5) * down // camera.height, 0, down - 1).astype(int)
    return np.bincount(rows * across + columns, minlength=across * down).reshape(down, across)


@dataclass(frozen=True, eq=False)
class _Pair:
    """Photo and render as they are compared.

    Attributes:
        photo, render: (H, W) uint8 brightness.
        covered: (H, W) bool, where the map covers the photo and the lens sees.
    """

    photo: np.ndarray
    render: np.ndarray
    covered: np.ndarray

    @staticmethod
    def of(photo: Photo, view: MatchedView) -> _Pair:
        """Make both as small as they are compared."""
        camera = photo.camera
        scale = min(1.0, _FOCAL_LENGTH / camera.K[0, 0])
        size = (max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
        covered = photo.seen & (to_host(view.render.alpha) >= _MIN_ALPHA)
        return _Pair(
            shrunk(photo.gray(), *size),
            shrunk(cv2.cvtColor(to_host(view.image), cv2.COLOR_RGB2GRAY), *size),
            # As bytes, of which that is a whole number.
            shrunk(covered * np.uint8(200), *size) > 200 * _MIN_COVERED,
        )

    def structures(self, counted: np.ndarray) -> _Structures:
        """Return the local structures of both where pixels (H, W) bool count: others say nothing about these."""
        (photo, photo_contrast), (render, render_contrast) = (
            local_structure(gray, _NEIGHBOURHOOD, _MIN_CONTRAST, counted) for gray in (self.photo, self.render)
        )
        compared = counted & (np.maximum(photo_contrast, render_contrast) >= _MIN_CONTRAST)
        return _Structures(photo, render, counted, compared)


@dataclass(frozen=True, eq=False)
class _Structures:
    """The local structures of photo and render.

    Attributes:
        photo, render: (H, W) float32, 0 where pixels do not count.
        counted: (H, W) bool, where they do.
        compared: (H, W) bool, where there also is contrast in one of the two.
    """

    photo: np.ndarray
    render: np.ndarray
    counted: np.ndarray
    compared: np.ndarray

    def correlation(self) -> np.ndarray:
        """Return the correlation (12, 16) of the two in each cell; NaN where there is nothing to compare."""
        rows, columns = _cells(*self.photo.shape)

        def total(values: np.ndarray) -> np.ndarray:
            return (rows @ values.astype(np.float32, copy=False) @ columns).astype(np.float64)

        area, counted_area = self.photo.size / (CELLS[0] * CELLS[1]), total(self.counted)
        enough = (counted_area >= _MIN_COVERED_SHARE * area) & (
            total(self.compared) >= _MIN_CONTRAST_SHARE * counted_area
        )
        squares = total(self.photo * self.photo) * total(self.render * self.render)
        correlation = total(self.photo * self.render) / np.sqrt(np.maximum(squares, np.finfo(np.float64).tiny))
        return np.where(enough & (counted_area > 0), correlation, np.nan)

    def changed(self, min_width: int) -> np.ndarray:
        """Return where the photo shows something else than the map, in parts at least so many pixels wide: (H, W)."""
        # What is smooth is computed at half the size.
        height, width = self.photo.shape
        half = (-(-width // 2), -(-height // 2))
        photo, render = (np.where(self.compared, structure, np.float32(0)) for structure in (self.photo, self.render))
        product, square_photo, square_render = (
            cv2.GaussianBlur(cv2.resize(values, half, interpolation=cv2.INTER_AREA), (0, 0), 0.25 * _NEIGHBOURHOOD)
            for values in (photo * render, photo**2, render**2)
        )
        alike = product >= _MIN_CORRELATION * np.sqrt(square_photo * square_render)
        compared = cv2.resize(self.compared.astype(np.uint8), half, interpolation=cv2.INTER_NEAREST)
        changed = np.where(alike, np.uint8(0), compared)
        for operation, side in ((cv2.MORPH_CLOSE, _BRUSH), (cv2.MORPH_OPEN, min_width)):
            brush = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side // 2 | 1, side // 2 | 1))
            changed = cv2.morphologyEx(changed, operation, brush)
        return cv2.resize(changed, (width, height), interpolation=cv2.INTER_NEAREST) > 0


@lru_cache(maxsize=4)
def _cells(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Return which rows of a picture are of a row of cells (12, H), and which columns of a column (W, 16): 1 or 0."""
    across, down = CELLS
    rows = np.arange(down)[:, None] == np.arange(height) * down // height
    columns = (np.arange(width) * across // width)[:, None] == np.arange(across)
    return rows.astype(np.float32), columns.astype(np.float32)
