"""Compressed images that hold no picture: the installed localizer says why not, takes no memory for it, serves on."""

from __future__ import annotations

import re
import zlib
from pathlib import Path

import cv2
from hypothesis import given
from malformed import assert_refused, compressed_images, examples
from node_harness import NodeProcess, assert_close, connected_client, running_localizer
from picture_files import jpeg_with_hidden_size, png
from sensor_msgs.msg import CompressedImage, Image

from gsfeatloc_ros.client.messages import camera_info_of, pose_stamped

PARAMETERS = {"image__transport": "compressed", "matcher__name": "sift", "localizer__max_views": 4}


def peak_memory(localizer: NodeProcess) -> float:
    """Most memory that the localizer ever had, in MB."""
    status = Path(f"/proc/{localizer.pid}/status").read_text()
    return int(re.search(r"VmHWM:\s+(\d+) kB", status).group(1)) / 1024


def test_compressed_images(room_map_file, room_camera, room_photos):
    photo = room_photos[0]
    encoded = cv2.imencode(".jpeg", photo.image[:, :, ::-1])[1].tobytes()
    with (
        running_localizer(map__path=room_map_file, **PARAMETERS) as localizer,
        connected_client(transport="compressed") as client,
    ):
        client.send_camera_info(camera_info_of(room_camera))
        client.send_prior(pose_stamped(photo.T_map_camera_prior))

        def assert_good_one_is_answered() -> None:
            image = CompressedImage(format="jpeg", data=encoded)
            image.header.frame_id = "camera_optical"
            assert client.attempt(image).ok
            assert_close(client.pose_of(image), photo.T_map_camera)

        assert_good_one_is_answered()
        before = peak_memory(localizer)

        @examples(50)
        @given(compressed_images(photo.image))
        def check(case):
            assert_refused(client, "image/compressed", *case)

        check()
        # A few bytes that hold 200 megapixels of black.
        bomb = CompressedImage(format="png", data=png(20_000, 10_000, zlib.compress(bytes(20_001 * 10_000))))
        assert_refused(client, "image/compressed", bomb, "20000x10000")
        # Some hundred bytes that hold 900, behind a header of the camera's size; neither is it decoded to be drawn.
        pictures = client.listen(Image, "debug_image")
        grey = cv2.imencode(".jpeg", photo.image[:8, :8])[1].tobytes()
        bomb = CompressedImage(format="jpeg", data=jpeg_with_hidden_size(grey, 640, 480, 30_000))
        assert_refused(client, "image/compressed", bomb, "is a damaged JPEG")
        assert client.spin_until(lambda: pictures)
        # A JPEG that ends early is a picture with a grey rest to decoders.
        for part in (0.1, 0.3, 0.5, 0.7, 0.9):
            image = CompressedImage(format="jpeg", data=encoded[: int(part * len(encoded))])
            image.header.frame_id = "camera_optical"
            diagnostic = client.attempt(image)
            if diagnostic.ok:
                assert_close(client.pose_of(image), photo.T_map_camera)
            else:
                assert diagnostic.values["status"] in ("refused", "failed", "rejected")
        assert peak_memory(localizer) - before < 200.0
        assert_good_one_is_answered()
        assert "Traceback" not in localizer.output
