"""An inspection as one HTML page that needs nothing else."""

from __future__ import annotations

import base64
import datetime
from importlib.resources import files

import cv2
import numpy as np

from gsfeatloc_ros.evaluate.extras import import_extra
from gsfeatloc_ros.inspect.inspection import Inspection
from gsfeatloc_ros.inspect.text import rows

_QUALITY = 88


def as_page(inspection: Inspection, command: str) -> str:
    """Return the page.

    Args:
        inspection: to be shown.
        command: the command line that made it.

    Raises:
        RuntimeError: jinja2 is not installed.
    """
    environment = import_extra("jinja2").Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    template = files(__package__).joinpath("page.html.j2").read_text(encoding="utf-8")
    return environment.from_string(template).render(
        inspection=inspection,
        rows=[row for row in rows(inspection) if row[0] not in ("opacity", "scale")],
        views=[_data_url(view) for view in inspection.views],
        command=command,
        date=datetime.datetime.now().astimezone().strftime("%d %B %Y, %H:%M %Z"),
    )


def _data_url(picture: np.ndarray) -> str:
    """Return an RGB picture (H, W, 3) uint8 as a JPEG in a URL."""
    coded = cv2.imencode(".jpg", picture[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]
    return "data:image/jpeg;base64," + base64.b64encode(coded.tobytes()).decode()
