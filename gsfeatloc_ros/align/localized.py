"""Where the photos of a bag were taken, in the frame in which the map lies now."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsfeatloc_ros.align.pairs import Answer
from gsfeatloc_ros.localize.engine import load_engine
from gsfeatloc_ros.localize.map_index import index_for, index_key
from gsfeatloc_ros.replay.bag import Role, open_bag
from gsfeatloc_ros.replay.run import Replay
from gsfeatloc_ros.ros_io.message_types import CameraInfo
from gsfeatloc_ros.ros_io.settings import Settings


def localize_bag(
    path: Path, topics: Mapping[Role, Sequence[str]], settings: Settings, calibration: CameraInfo | None
) -> Iterator[Answer | None]:
    """Localize the photos of a bag as the node would, and yield an answer for each that is due; None for no answer.

    Each photo starts from the answer to the one before, or a prior of the bag, or is looked for in the index of views.
    Odometry carries no prior: its unit is not yet the map's.

    Args:
        path: of the bag.
        topics: of images, and of camera_info and priors where there are some.
        settings: the node's, but that it tracks.
        calibration: of the camera, where the bag has none.

    Raises:
        ValueError, OSError, RuntimeError: bag, map or settings cannot be used; the message says why.
    """
    settings = replace(settings, node=replace(settings.node, track=True))
    with open_bag(path, topics) as bag:
        engine = load_engine(settings.map, settings.matcher, settings.renderer, settings.localizer)
        key = index_key(engine.map_path, settings.map, settings.matcher, settings.index)
        index = index_for(engine, settings.index, key)
        for image in Replay(bag, engine.with_index(index), settings, calibration).images():
            found = image.outcome.estimate
            if image.stamp is None or not image.outcome.localized or found is None or found.T_map_camera is None:
                yield None
                continue
            variances = np.zeros(2) if found.covariance is None else found.covariance.diagonal().reshape(2, 3).mean(1)
            yield Answer(image.stamp, found.T_map_camera, variances)
