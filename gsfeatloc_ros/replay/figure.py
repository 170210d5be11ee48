"""A picture of the errors of what was localized in a bag."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsfeatloc_ros.evaluate.extras import import_extra
from gsfeatloc_ros.localize.settings import MapSettings
from gsfeatloc_ros.replay.output import errors
from gsfeatloc_ros.replay.run import ReplayedImage
from gsfeatloc_ros.replay.truth import Trajectory

# Okabe and Ito's colours, which the colour-blind can tell apart.
_ANSWER, _PRIOR, _NONE, _TRUTH = "#0072b2", "#e69f00", "#d55e00", "#8a94a0"


def write_figure(path: Path, images: Sequence[ReplayedImage], truth: Trajectory, map_: MapSettings) -> None:
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
    _draw_from_above(figure.add_subplot(grid[:, 1]), images, truth, map_)
    figure.savefig(path, dpi=110)


def up_axis(poses: np.ndarray) -> int:
    """Return the axis of the map that points up, or down, for cameras that are held upright: 0, 1 or 2 for x, y, z.

    Args:
        poses: (N, 4, 4) T_map_camera of the cameras, whose y points down.
    """
    return int(np.argmax(np.abs(poses[:, :3, 1].sum(axis=0)))) if len(poses) else 2


def _draw_from_above(axes: Any, images: Sequence[ReplayedImage], truth: Trajectory, map_: MapSettings) -> None:
    answers = [image.T_map_camera for image in images if image.T_map_camera is not None]
    poses = np.reshape(np.array([*truth.poses, *answers]), (-1, 4, 4))
    # In the robot's map frame z is up; in that of a reconstruction it may be any.
    up = 2 if map_.aligned else up_axis(poses)
    is_down = not map_.aligned and poses[:, up, 1].sum() > 0
    across, along = ((1, 2), (2, 0), (0, 1))[up]
    known, found = np.split(poses[:, :3, 3], [len(truth)])
    axes.plot(known[:, across], known[:, along], color=_TRUTH, linewidth=1.5, label="truth")
    axes.plot(found[:, across], found[:, along], ".", color=_ANSWER, label="answers")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_title("Trajectory from above", loc="left")
    axes.set_xlabel(f"{'xyz'[across]} of {map_.frame_id}, map units")
    axes.set_ylabel("xyz"[along])
    if is_down:
        axes.invert_yaxis()
    axes.grid(color="#e4e8ec")
    axes.legend(frameon=False)
