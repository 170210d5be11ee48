"""A picture of the errors of what was localized in a bag."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsfeatloc_ros.evaluate.extras import import_extra
from gsfeatloc_ros.replay.output import errors
from gsfeatloc_ros.replay.run import ReplayedImage
from gsfeatloc_ros.replay.truth import Trajectory

# Okabe and Ito's colours, which the colour-blind can tell apart.
_ANSWER, _PRIOR, _NONE, _TRUTH = "#0072b2", "#e69f00", "#d55e00", "#8a94a0"


def write_figure(path: Path, images: Sequence[ReplayedImage], truth: Trajectory, map_frame: str) -> None:
    """Draw the errors of answers and priors over time, and the trajectory from above, into a .png.

    Images without an answer are marked below the errors.

    Raises:
        RuntimeError: matplotlib is not installed.
    """
    figure = import_extra("matplotlib.figure").Figure(figsize=(13, 6.5), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(1.5, 1))
    rotation = figure.add_subplot(grid[0, 0])
    translation = figure.add_subplot(grid[1, 0], sharex=rotation)
    stamped = [(image.stamp, image) for image in images if image.stamp is not None]
    start = min((stamp for stamp, _ in stamped), default=0)
    times = np.array([1e-9 * (stamp - start) for stamp, _ in stamped])
    values = [errors(image, truth) for _, image in stamped]
    unanswered = np.array([image.pose is None for _, image in stamped], dtype=bool)
    for axes, key, title in (
        (rotation, "rotation_error_deg", "Rotation error, degrees"),
        (translation, "translation_error", "Translation error, map units"),
    ):
        for name, prefix, colour in (("answer", "", _ANSWER), ("prior", "prior_", _PRIOR)):
            series = np.array([value.get(prefix + key, np.nan) for value in values])
            axes.plot(times, series, ".-", color=colour, linewidth=0.8, label=name)
        if unanswered.any():
            below = np.full(unanswered.sum(), 0.02)
            axes.plot(
                times[unanswered], below, "x", color=_NONE, label="no answer", transform=axes.get_xaxis_transform()
            )
        axes.set_yscale("log")
        axes.set_title(title, loc="left")
        axes.grid(color="#e4e8ec")
    rotation.tick_params(labelbottom=False)
    translation.set_xlabel("seconds since the first image")
    rotation.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    _draw_from_above(figure.add_subplot(grid[:, 1]), images, truth, map_frame)
    figure.savefig(path, dpi=110)


def _draw_from_above(axes: Any, images: Sequence[ReplayedImage], truth: Trajectory, map_frame: str) -> None:
    positions = [image.pose.T_map_camera[:3, 3] for image in images if image.pose is not None]
    x, y = np.reshape(positions, (-1, 3))[:, :2].T
    axes.plot(*truth.positions[:, :2].T, color=_TRUTH, linewidth=1.5, label="truth")
    axes.plot(x, y, ".", color=_ANSWER, label="answers")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_title("Trajectory from above", loc="left")
    axes.set_xlabel(f"x of {map_frame}, map units")
    axes.set_ylabel("y")
    axes.grid(color="#e4e8ec")
    axes.legend(frameon=False)
