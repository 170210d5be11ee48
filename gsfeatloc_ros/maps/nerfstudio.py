"""Where nerfstudio puts the Gaussians that it trains."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsfeatloc_ros.common.json_file import read_json
from gsfeatloc_ros.maps.gaussian_map import MapError
from gsfeatloc_ros.maps.similarity import Similarity


def read_dataparser_transforms(path: str | Path) -> Similarity:
    """Read the ``S_map_splat`` of a map that nerfstudio trained, for a map frame that is the frame of its data.

    nerfstudio moves its data to train on them, x_splat = scale * (transform @ x_data), and exports its Gaussians in
    that frame. It writes the transform (3, 4) and the scale to dataparser_transforms.json beside the config.yml.

    Raises:
        MapError: the file cannot be read or holds no such transform.
    """
    try:
        content = read_json(Path(path))
        transform, scale = np.array(content["transform"], dtype=np.float64), float(content["scale"])
        if transform.shape != (3, 4):
            raise ValueError(f"its transform is of shape {transform.shape}, not (3, 4)")
        return Similarity(scale, transform[:, :3], scale * transform[:, 3]).inverse()
    except OSError as error:
        raise MapError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (KeyError, TypeError, ValueError) as error:
        raise MapError(f"{path}: is not a dataparser_transforms.json of nerfstudio: {error}") from error
