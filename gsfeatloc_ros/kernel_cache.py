"""Where numba keeps compiled kernels. This is read before numba is imported, and imports nothing of it."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

_BESIDE_SOURCES = Path(__file__).parent / "render" / "__pycache__"


def set_kernel_cache() -> None:
    """Let numba keep compiled kernels in a user's cache folder where it cannot do so beside their sources.

    That is $XDG_CACHE_HOME/gsfeatloc_ros/numba or ~/.cache/gsfeatloc_ros/numba. A NUMBA_CACHE_DIR that is set stays.
    """
    if os.environ.get("NUMBA_CACHE_DIR") or can_write(_BESIDE_SOURCES):
        return
    folder = user_cache_folder() / "numba"
    # Without any place numba refuses to load the kernels; this one lasts for the process and those it starts.
    os.environ["NUMBA_CACHE_DIR"] = str(folder) if can_write(folder) else tempfile.mkdtemp(prefix="gsfeatloc_ros-")


def kernel_cache_folder() -> Path:
    """Where numba keeps compiled kernels, once set_kernel_cache was called."""
    return Path(os.environ.get("NUMBA_CACHE_DIR") or _BESIDE_SOURCES)


def user_cache_folder() -> Path:
    """This package's folder under $XDG_CACHE_HOME or ~/.cache; it need not exist."""
    root = os.environ.get("XDG_CACHE_HOME", "")
    # By the specification a relative one is to be ignored.
    return (Path(root) if os.path.isabs(root) else Path(os.path.expanduser("~"), ".cache")) / "gsfeatloc_ros"


def can_write(folder: Path) -> bool:
    """Whether files can be made in `folder`, which is made itself if need be: what permissions say is not enough."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return folder.is_absolute()
