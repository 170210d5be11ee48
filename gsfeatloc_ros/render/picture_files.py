"""Renders in files: colour, depth, coverage; and as a video."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from gsfeatloc_ros.common.arrays import to_host
from gsfeatloc_ros.common.replaced_file import replaced_file
from gsfeatloc_ros.render.base import Render

# Of a 16-bit picture; 0 stands for no depth.
_FARTHEST = 65535


def write_pictures(prefix: Path, render: Render, depth_scale: float) -> int:
    """Write PREFIX.png, PREFIX_depth.png (16 bits), PREFIX_depth.npy (float32, map units) and PREFIX_alpha.png.

    The depth is the median's (render/base.py), along z; where there is none it is 0 in the picture, NaN in the array.

    Args:
        prefix: of the paths.
        render: to write.
        depth_scale: levels of PREFIX_depth.png in a map unit.

    Returns:
        The number of pixels that are too far for the picture, where they are 0.

    Raises:
        OSError: a file cannot be written.
    """
    depth, alpha = to_host(render.median_depth), to_host(render.alpha)
    levels = np.rint(np.nan_to_num(depth.astype(np.float64), nan=0.0) * depth_scale)
    too_far = levels > _FARTHEST
    _write_png(prefix.with_name(f"{prefix.name}.png"), render.image()[:, :, ::-1])
    _write_png(prefix.with_name(f"{prefix.name}_depth.png"), np.where(too_far, 0, levels).astype(np.uint16))
    _write_png(prefix.with_name(f"{prefix.name}_alpha.png"), np.rint(alpha * 255).astype(np.uint8))
    with replaced_file(prefix.with_name(f"{prefix.name}_depth.npy")) as stream:
        np.save(stream, depth)
    return int(too_far.sum())


def _write_png(path: Path, picture: np.ndarray) -> None:
    with replaced_file(path) as stream:
        stream.write(cv2.imencode(".png", picture)[1].tobytes())


class Video:
    """An MP4 that is being written."""

    def __init__(self, writer: cv2.VideoWriter) -> None:
        self._writer = writer

    def add(self, render: Render) -> None:
        """Append a frame."""
        self._writer.write(np.ascontiguousarray(render.image()[:, :, ::-1]))


@contextmanager
def written_video(path: Path, rate: float, size: tuple[int, int]) -> Iterator[Video]:
    """Write an MP4 (MPEG-4 part 2, which OpenCV's wheels can write) in the block.

    Args:
        path: of the file.
        rate: frames a second.
        size: width and height of the frames, in pixels.

    Raises:
        ValueError: the size is odd.
        RuntimeError: this OpenCV, or this place, takes no MP4.
    """
    if size[0] % 2 or size[1] % 2:
        raise ValueError(f"frames of {size[0]}x{size[1]} make no video: width and height must be even")
    # Without the others that OpenCV would try: they complain on the terminal.
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"mp4v"), rate, size)
    try:
        if not writer.isOpened():
            raise RuntimeError(f"{path}: no video can be written there, or this OpenCV has no writer of MP4")
        yield Video(writer)
    finally:
        writer.release()
