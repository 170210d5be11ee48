"""What is slow the first time, done before the first photo: compiling kernels, running networks."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numba.core import event

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.localize.estimate import Estimate
from gsfeatloc_ros.localize.evidence import Limits
from gsfeatloc_ros.localize.localizer import Localizer
from gsfeatloc_ros.localize.options import LocalizerOptions
from gsfeatloc_ros.maps.gaussian_map import SH_COEFFICIENTS, GaussianMap
from gsfeatloc_ros.match import Matcher
from gsfeatloc_ros.render import create_renderer

_CAMERA = Camera(320, 240, np.array([[300.0, 0, 159.5], [0, 300.0, 119.5], [0, 0, 1]]))
# A wall of patches of one colour each, so many discs wide, that fills the picture.
_PATCHES, _PATCH, _SPACING, _DISTANCE = (18, 14), 4, 0.033, 2.0


@dataclass(frozen=True, eq=False)
class WarmUp:
    """What was done.

    Attributes:
        compiled: number of functions that were compiled; 0 when all were in numba's cache.
        kernels_seconds: wall time until all kernels had run.
        localization_seconds: wall time of the localization.
        estimate: what came of the localization; None without a matcher.
    """

    compiled: int
    kernels_seconds: float
    localization_seconds: float
    estimate: Estimate | None


def warm_up(matcher: Matcher | None = None, device: str = "auto", threads: int = 0) -> WarmUp:
    """Render made-up maps of every kind, and with a matcher localize in one: all code and networks have then run.

    Args:
        matcher: to localize with; None for the kernels alone.
        device, threads: as in create_renderer.

    Raises:
        ValueError: an unknown device.
    """
    start = time.perf_counter()
    with event.install_recorder("numba:compile") as compilations:
        for coefficients in SH_COEFFICIENTS:
            for antialiased in (False, True):
                renderer = create_renderer(_wall(coefficients, antialiased), device, threads)
                photo = renderer.render(_CAMERA, np.eye(4)).image()
    rendered = time.perf_counter()
    # A wall from the front would not show a wrong focal length.
    options = LocalizerOptions(limits=Limits(max_focal_error=1.0))
    estimate = None if matcher is None else Localizer(renderer, matcher, options).localize(photo, _CAMERA, np.eye(4))
    return WarmUp(
        compiled=sum(event_.is_start for _, event_ in compilations.buffer),
        kernels_seconds=rendered - start,
        localization_seconds=time.perf_counter() - rendered,
        estimate=estimate,
    )


def _wall(coefficients: int, antialiased: bool) -> GaussianMap:
    rng = np.random.default_rng(0)
    colours = rng.uniform(-1.5, 1.5, (_PATCHES[1], _PATCHES[0], 3)).repeat(_PATCH, 0).repeat(_PATCH, 1)
    rows, columns = colours.shape[:2]
    x, y = np.meshgrid(np.arange(columns) - columns / 2, np.arange(rows) - rows / 2)
    means = np.column_stack([_SPACING * x.ravel(), _SPACING * y.ravel(), np.full(x.size, _DISTANCE)])
    sh = np.zeros((x.size, coefficients, 3), np.float32)
    sh[:, 0] = colours.reshape(-1, 3)
    return GaussianMap(
        means=means.astype(np.float32),
        scales=np.tile(np.array([0.5 * _SPACING, 0.5 * _SPACING, 0.001], np.float32), (x.size, 1)),
        rotations=np.tile(np.array([1, 0, 0, 0], np.float32), (x.size, 1)),
        opacities=np.full(x.size, 0.95, np.float32),
        sh=sh,
        antialiased=antialiased,
    )
