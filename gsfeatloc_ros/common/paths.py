"""Paths as people write them."""

from __future__ import annotations

import os
from urllib.parse import unquote, urlsplit


def local_path(text: str) -> str:
    """Return the path of a file that may be given with `~` for the home folder, or as a file:// URL.

    Raises:
        ValueError: the URL is of another machine's file.
    """
    if not text.startswith("file:"):
        return os.path.expanduser(text)
    url = urlsplit(text)
    if url.netloc not in ("", "localhost"):
        raise ValueError(
            f"{text} is a file of the machine {url.netloc}: three slashes begin a path (file:///{url.netloc})"
        )
    return unquote(url.path)
