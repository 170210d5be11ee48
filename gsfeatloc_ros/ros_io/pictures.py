"""Decode the images of streams, raw or compressed, with what earlier ones told of them."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from gsfeatloc_ros.common.jpeg_png import Picture
from gsfeatloc_ros.ros_io.compressed_image import decode_compressed_image, encoding_of, open_compressed_image
from gsfeatloc_ros.ros_io.message_types import AnyImage, CompressedImage, Image
from gsfeatloc_ros.ros_io.raw_image import (
    ENCODINGS,
    SAMPLE_BITS,
    decode_image,
    in_8_bits,
    largest_sample,
    needed_bits,
    validate_image,
)

_log = logging.getLogger(__name__)

# In 16 bits and one channel depth cameras send millimetres, and some infrared ones pictures.
_DEPTH_OR_INFRARED = "16UC1"


@dataclass(frozen=True, eq=False)
class OpenedPicture:
    """The picture of an image message whose header was read.

    Attributes:
        width, height: in pixels.
        decode: returns the pixels (H, W, 3) uint8 RGB; raises ValueError where they cannot be had.
    """

    width: int
    height: int
    decode: Callable[[], np.ndarray]


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

    def open(self, message: AnyImage) -> OpenedPicture:
        """Return the picture of an image message of either type.

        Raises:
            PictureError: see open_compressed_image.
        """
        if isinstance(message, CompressedImage):
            picture = open_compressed_image(message)
            return OpenedPicture(picture.width, picture.height, partial(self._decode_compressed, message, picture))
        return OpenedPicture(message.width, message.height, partial(self._decode_raw, message))

    def decode(self, message: AnyImage) -> np.ndarray:
        """Return the pixels (H, W, 3) uint8 RGB of an image message of either type.

        Raises:
            ValueError: see decode_image and open_compressed_image; or an image of 16UC1, or one of larger values than
                it is said to have.
        """
        return self.open(message).decode()

    def _decode_raw(self, message: Image) -> np.ndarray:
        validate_image(message)
        self._refuse_depth(message.encoding)
        if ENCODINGS[message.encoding].bits == SAMPLE_BITS[0]:
            return decode_image(message)
        return decode_image(message, self._bits_of(message, message.encoding, largest_sample(message)))

    def _decode_compressed(self, message: CompressedImage, picture: Picture) -> np.ndarray:
        encoding = encoding_of(message)
        self._refuse_depth(encoding)
        pixels = decode_compressed_image(message, picture)
        if picture.bits == SAMPLE_BITS[0]:
            return pixels
        return in_8_bits(pixels, self._bits_of(message, encoding, int(pixels.max())))

    def _refuse_depth(self, encoding: str) -> None:
        if encoding == _DEPTH_OR_INFRARED and not self._bits:
            raise ValueError(
                f"image encoding {encoding!r} is that of depth images: take the topic of the pictures; for an infrared "
                "camera set image.bits to how many its pixels have"
            )

    def _bits_of(self, message: AnyImage, encoding: str, largest: int) -> int:
        """Return how many bits of a 16-bit image's samples are used."""
        needed = needed_bits(largest)
        if self._bits:
            if needed > self._bits:
                raise ValueError(f"image has values of {needed} bits, more than image.bits:={self._bits} says")
            return self._bits
        stream = (message.header.frame_id, encoding)
        before = self._found.get(stream, 0)
        if needed > before:
            self._found[stream] = needed
            if needed < SAMPLE_BITS[-1]:
                self._say(
                    f"{encoding} images of frame {message.header.frame_id!r} have values of {needed} bits: the "
                    "largest of these is white (image.bits)"
                )
        return max(needed, before)
