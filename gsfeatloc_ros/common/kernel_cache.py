"""Where numba keeps compiled kernels (render/kernels.py). This imports nothing of numba."""

from __future__ import annotations

import hashlib
import os
import tempfile
from pathlib import Path

_PACKAGE = Path(__file__).parents[1]
_BESIDE_SOURCES = _PACKAGE / "render" / "__pycache__"


def set_kernel_cache() -> None:
    """Let numba keep compiled kernels where it can write, in a folder of their own for each state of their sources.

    numba looks whether the file that a kernel stands in has changed, not whether what it imports has. The folder is
    below NUMBA_CACHE_DIR where that is set; otherwise beside the sources, or where that cannot be written to, below
    $XDG_CACHE_HOME/gsfeatloc_ros/numba or ~/.cache/gsfeatloc_ros/numba. NUMBA_CACHE_DIR is it from then on, also in
    the processes that this one starts.
    """
    name = f"kernels-{hash_of_sources('render')[:16]}"
    root = os.environ.get("NUMBA_CACHE_DIR") or next(
        (folder for folder in (_BESIDE_SOURCES, user_cache_folder() / "numba") if can_write(folder)), None
    )
    # Without any place numba refuses to load the kernels; this one lasts for the process and those it starts.
    root = Path(root or tempfile.mkdtemp(prefix="gsfeatloc_ros-"))
    # Processes inherit it from those that start them.
    if root.name != name:
        os.environ["NUMBA_CACHE_DIR"] = str(root / name)


def kernel_cache_folder() -> Path:
    """Return where numba keeps compiled kernels, once set_kernel_cache was called."""
    return Path(os.environ["NUMBA_CACHE_DIR"])


def hash_of_sources(*folders: str) -> str:
    """Return the SHA-256 of the sources in some of the package's folders.

    It is the version of what they make and keep in files.
    """
    digest = hashlib.sha256()
    for folder in folders:
        for source in sorted((_PACKAGE / folder).glob("*.py")):
            digest.update(source.read_bytes())
    return digest.hexdigest()


def user_cache_folder() -> Path:
    """Return this package's folder under $XDG_CACHE_HOME or ~/.cache; it need not exist."""
    root = os.environ.get("XDG_CACHE_HOME", "")
    # By the specification a relative one is to be ignored.
    return (Path(root) if os.path.isabs(root) else Path(os.path.expanduser("~"), ".cache")) / "gsfeatloc_ros"


def can_write(folder: Path) -> bool:
    """Return whether files can be made in `folder`, which is made itself if need be.

    One is made: what permissions say is not enough.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return folder.is_absolute()
