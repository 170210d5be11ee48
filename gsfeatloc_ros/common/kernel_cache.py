"""Where numba keeps compiled kernels (common/kernels.py). This imports nothing of numba."""

from __future__ import annotations

import atexit
import contextlib
import hashlib
import logging
import os
import shutil
import stat
import tempfile
from pathlib import Path

from gsfeatloc_ros.common.safe_files import check_own

_log = logging.getLogger(__name__)

_PACKAGE = Path(__file__).parents[1]
_BESIDE_SOURCES = _PACKAGE / "render" / "__pycache__"


def set_kernel_cache() -> None:
    """Let numba keep compiled kernels where it can write, in a folder of their own for each state of their sources.

    numba looks whether the file that a kernel stands in has changed, not whether what it imports has. The folder is
    below NUMBA_CACHE_DIR where that is set; otherwise beside the sources, or where that cannot be written to, below
    $XDG_CACHE_HOME/gsfeatloc_ros/numba or ~/.cache/gsfeatloc_ros/numba. It is this user's alone. NUMBA_CACHE_DIR is it
    from then on, also in the processes that this one starts.
    """
    name = f"kernels-{hash_of_sources('common', 'match', 'pose', 'render')[:16]}"
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    # Processes inherit it from those that start them.
    roots = [Path(chosen).parent if Path(chosen).name == name else Path(chosen)] if chosen else _usual_roots()
    folder = next((root / name for root in roots if _make_own(root / name)), None)
    if folder is None:
        # Without any place numba refuses to load the kernels; this one lasts for the process and those it starts.
        folder = Path(tempfile.mkdtemp(prefix="gsfeatloc_ros-"))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        folder = folder / name
        folder.mkdir(mode=0o700)
        _log.warning("compiled kernels are kept in %s for this run only: no other user may write to %s", folder, roots)
    os.environ["NUMBA_CACHE_DIR"] = str(folder)


def _usual_roots() -> list[Path]:
    return [_BESIDE_SOURCES, user_cache_folder() / "numba"]


def _make_own(folder: Path) -> bool:
    """Make a folder that nobody else can write to, unless it is there; return whether it is, and is writable.

    What lies in it is code that numba runs.
    """
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileExistsError):
            folder.mkdir(mode=0o700)
        status, parent = folder.lstat(), folder.parent.stat()
        check_own(status)
    except OSError:
        return False
    # Where anybody can write and no sticky bit is set, anybody can put another folder in its place.
    replaceable = parent.st_mode & stat.S_IWOTH and not parent.st_mode & stat.S_ISVTX
    return stat.S_ISDIR(status.st_mode) and not replaceable and can_write(folder)


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
