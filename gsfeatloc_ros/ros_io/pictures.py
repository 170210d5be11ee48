"""Decode the images of streams, raw or compressed, with what earlier ones told of them."""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np

from gsfeatloc_ros.ros_io.decode import decode_compressed_image
from gsfeatloc_ros.ros_io.message_types import AnyImage, CompressedImage, Image
from gsfeatloc_ros.ros_io.raw_image import ENCODINGS, SAMPLE_BITS, decode_image, needed_bits, validate_image

_log = logging.getLogger(__name__)

# In 16 bits and one channel depth cameras send millimetres, and some infrared ones pictures.
_DEPTH_OR_INFRARED = "16UC1"


class PictureReader:
    """Decodes images of any number of streams, each told by its frame and encoding; for one thread.

    Sensors of 10, 12 or 14 bits fill 16-bit images from below. How many bits a stream has is what its largest value up
    to now needs.

    Args:
        bits: of the samples of all 16-bit images; 0 to find out. Images of 16UC1, which may be of depth, are only
            taken if somebody says.
        say: is told once of each stream how many bits were found.
    """

    def __init__(self, bits: int = 0, say: Callable[[str], None] = _log.info) -> None:
        self._bits, self._say = bits, say
        self._found: dict[tuple[str, str], int] = {}

    def decode(self, message: AnyImage) -> np.ndarray:
        """Return the pixels (H, W, 3) uint8 RGB of an image message of either type.

        Raises:
            ValueError: see decode_image and decode_compressed_image; or an image of 16UC1, or one of larger values
                than it is said to have.
        """
        if isinstance(message, CompressedImage):
            return decode_compressed_image(message)
        validate_image(message)
        return decode_image(message, self._bits_of(message))

    def _bits_of(self, message: Image) -> int:
        """Return how many bits of the image's samples are used."""
        if ENCODINGS[message.encoding].bits == SAMPLE_BITS[0]:
            return SAMPLE_BITS[0]
        if message.encoding == _DEPTH_OR_INFRARED and not self._bits:
            raise ValueError(
                f"image encoding {message.encoding!r} is that of depth images: take the topic of the pictures; for an "
                "infrared camera set image.bits to how many its pixels have"
            )
        needed = needed_bits(message)
        if self._bits:
            if needed > self._bits:
                raise ValueError(f"image has values of {needed} bits, more than image.bits:={self._bits} says")
            return self._bits
        stream = (message.header.frame_id, message.encoding)
        before = self._found.get(stream, 0)
        if needed > before:
            self._found[stream] = needed
            if needed < SAMPLE_BITS[-1]:
                self._say(
                    f"{message.encoding} images of frame {message.header.frame_id!r} have values of {needed} bits: the "
                    "largest of these is white (image.bits)"
                )
        return max(needed, before)
