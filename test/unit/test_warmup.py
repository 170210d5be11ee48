"""Compiling ahead of use, and where what was compiled is kept."""

from __future__ import annotations

import os
import re
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest

import gsfeatloc_ros
from gsfeatloc_ros.common.kernel_cache import can_write, kernel_cache_folder, set_kernel_cache, user_cache_folder
from gsfeatloc_ros.localize.estimate import Status
from gsfeatloc_ros.localize.first_run import warm_up
from gsfeatloc_ros.match import create_matcher
from gsfeatloc_ros.tools import warmup


@pytest.fixture
def unwritable_install(tmp_path) -> Path:
    """A copy of the package beside whose kernels nothing can be kept, not even by root: a file is in the way."""
    root = tmp_path / "install"
    shutil.copytree(
        Path(gsfeatloc_ros.__file__).parent, root / "gsfeatloc_ros", ignore=shutil.ignore_patterns("__pycache__")
    )
    (root / "gsfeatloc_ros" / "render" / "__pycache__").touch()
    return root


def run(root: Path, *arguments: str, **variables: str) -> str:
    """Output of python on the package in `root`, with nothing set of where caches are but `variables`."""
    inherited = {name: value for name, value in os.environ.items() if name not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
    environment = inherited | {"PYTHONPATH": str(root), "PYTHONDONTWRITEBYTECODE": "1"} | variables
    # In `root`: python -m puts the working directory first.
    finished = subprocess.run(
        [sys.executable, *arguments], cwd=root, env=environment, capture_output=True, text=True, timeout=300
    )
    assert finished.returncode == 0, finished.stderr
    return finished.stdout


def cache_dir(root: Path, **variables: str) -> str:
    code = "import os, gsfeatloc_ros.common.kernels; print(os.environ.get('NUMBA_CACHE_DIR'))"
    return run(root, "-c", code, **variables).strip()


IMPORT = """
import os
before = dict(os.environ)

def changed():
    return sorted(name for name in before.keys() | os.environ.keys() if before.get(name) != os.environ.get(name))

import gsfeatloc_ros
print(*changed())
for name in gsfeatloc_ros.__all__:
    getattr(gsfeatloc_ros, name)
print(*changed())
"""


def test_the_import_sets_no_variable_and_makes_no_folder(unwritable_install, tmp_path):
    (unwritable_install / "gsfeatloc_ros" / "render" / "__pycache__").unlink()
    before = sorted(tmp_path.rglob("*"))
    homes = {"HOME": str(tmp_path / "home"), "TMPDIR": str(tmp_path), "LD_LIBRARY_PATH": ""}
    whole, names = run(unwritable_install, "-c", IMPORT, **homes).splitlines()
    assert whole == ""
    assert names in ("", "LD_LIBRARY_PATH")  # OpenCV's doing
    assert sorted(tmp_path.rglob("*")) == before


USE_OPENMP = """
import os
from gsfeatloc_ros.match import create_matcher
from gsfeatloc_ros.render import create_renderer
for create in (lambda: create_matcher("sift", device="cpu"), lambda: create_renderer(None, "nowhere")):
    os.environ.pop("OMP_WAIT_POLICY", None)
    try:
        create()
    except ValueError as error:
        pass
    print(os.environ.get("OMP_WAIT_POLICY"))
os.environ["OMP_WAIT_POLICY"] = "ACTIVE"
create_matcher("sift", device="cpu")
print(os.environ["OMP_WAIT_POLICY"])
"""


def test_threads_wait_passively_from_the_first_renderer_or_matcher_on(unwritable_install):
    assert run(unwritable_install, "-c", USE_OPENMP).split() == ["PASSIVE", "PASSIVE", "ACTIVE"]


def test_kernels_stay_beside_their_sources_where_they_can(unwritable_install):
    beside = unwritable_install / "gsfeatloc_ros" / "render" / "__pycache__"
    beside.unlink()
    assert Path(cache_dir(unwritable_install)).parent == beside


@pytest.mark.slow
def test_unwritable_install_keeps_kernels_in_the_users_cache(unwritable_install, tmp_path):
    where = cache_dir(unwritable_install, HOME=str(tmp_path / "home"))
    assert Path(where).parent == tmp_path / "home" / ".cache" / "gsfeatloc_ros" / "numba"
    where = cache_dir(unwritable_install, XDG_CACHE_HOME=str(tmp_path / "xdg"))
    assert Path(where).parent == tmp_path / "xdg" / "gsfeatloc_ros" / "numba"


@pytest.mark.slow
def test_kernels_are_kept_below_what_the_user_set_and_once_only(unwritable_install, tmp_path):
    where = cache_dir(unwritable_install, NUMBA_CACHE_DIR=str(tmp_path / "mine"))
    assert Path(where).parent == tmp_path / "mine"
    # As a process that this one starts has it.
    assert cache_dir(unwritable_install, NUMBA_CACHE_DIR=where) == where


@pytest.mark.slow
@pytest.mark.parametrize("source", ["common/lanes.py", "match/flow.py", "render/base.py"])
def test_kernels_of_other_sources_are_kept_apart(unwritable_install, tmp_path, source):
    where = {"NUMBA_CACHE_DIR": str(tmp_path)}
    before = cache_dir(unwritable_install, **where)
    with (unwritable_install / "gsfeatloc_ros" / source).open("a") as file:
        file.write("# changed\n")
    assert cache_dir(unwritable_install, **where) != before


def test_without_any_writable_home_kernels_are_kept_for_the_process(unwritable_install, tmp_path):
    (tmp_path / "home").touch()
    where = Path(cache_dir(unwritable_install, HOME=str(tmp_path / "home"), TMPDIR=str(tmp_path)))
    assert where.parent.parent == tmp_path
    assert can_write(where)


@pytest.mark.parametrize("kind", ["of a stranger", "loose", "a link", "a file", "in a folder of all"])
def test_kernels_that_others_can_have_compiled_are_not_loaded(tmp_path, monkeypatch, caplog, kind):
    """What lies there is code: others are kept for the process, and it is said."""
    root = tmp_path / "mine"
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(root))
    set_kernel_cache()
    folder = kernel_cache_folder()
    assert folder.parent == root
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    if kind == "of a stranger":
        if os.geteuid() != 0:
            pytest.skip("only root can give files away")
        os.chown(folder, 12345, 12345)
    elif kind == "loose":
        folder.chmod(0o770)
    elif kind == "in a folder of all":
        root.chmod(0o777)
    else:
        folder.rename(tmp_path / "elsewhere")
        folder.symlink_to(tmp_path / "elsewhere") if kind == "a link" else folder.touch()
    for _ in range(2):
        set_kernel_cache()
        assert root not in kernel_cache_folder().parents
        assert can_write(kernel_cache_folder())
    assert caplog.text.count("for this run only") == 1


TWICE = """
import resource, sys
from gsfeatloc_ros.common.kernels import njit

@njit(cache=True)
def twice(number):
    return 2 * number

@njit
def thrice(number):
    return 3 * number

if __name__ == "__main__":
    # A file can be made but not written, as on a full disk.
    if sys.argv[1] == "full":
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    print(twice(21), twice(1.5), thrice(1))
"""


def test_a_call_that_compiles_does_not_fail_for_its_cache(tmp_path):
    root = tmp_path / "root"
    root.mkdir()
    (root / "twice.py").write_text(TWICE)
    folder, package = tmp_path / "kernels", Path(gsfeatloc_ros.__file__).parents[1]
    environment = {**os.environ, "PYTHONPATH": str(package), "NUMBA_CACHE_DIR": str(folder)}

    def warnings(disk: str) -> str:
        command = [sys.executable, "twice.py", disk]
        finished = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, timeout=300)
        assert finished.stdout == "42 3.0 3\n", finished.stderr
        return finished.stderr

    said = rf"compiled kernels are for this run only, {folder}/\S+ cannot be used: .*\n"
    assert re.fullmatch(said, warnings("full"))
    assert not warnings("empty")
    (index,) = folder.rglob("twice.twice*.nbi")
    index.unlink()
    index.mkdir()
    assert re.fullmatch(said, warnings("empty"))


def test_relative_cache_home_is_ignored(monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", "cache")
    monkeypatch.setenv("HOME", "/home/somebody")
    assert user_cache_folder() == Path("/home/somebody/.cache/gsfeatloc_ros")


# What the node does after its warm-up: another map, another picture.
USE = """
import sys
from gsfeatloc_ros.benchmark.frames import pinhole
from gsfeatloc_ros.render import create_renderer
from gsfeatloc_ros.render.cache import load_prepared
import numpy as np
from numba.core import event
with event.install_recorder("numba:compile") as compilations:
    for _ in range(2):
        create_renderer(load_prepared(sys.argv[1])).render(pinhole((64, 48)), np.eye(4))
print(len(compilations.buffer))
"""


@pytest.mark.nightly
def test_kernels_of_an_unwritable_install_are_compiled_once(unwritable_install, tmp_path, room_map_file):
    where = {"XDG_CACHE_HOME": str(tmp_path)}
    first, second = (run(unwritable_install, "-m", "gsfeatloc_ros.tools.warmup", **where) for _ in range(2))
    assert "functions compiled" in first
    assert "all in the cache" in second
    assert f"kept in {tmp_path}/gsfeatloc_ros/numba" in second
    assert list((tmp_path / "gsfeatloc_ros" / "numba").rglob("*.nbc"))
    # None was left out.
    assert run(unwritable_install, "-c", USE, str(room_map_file), **where).strip() == "0"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sift", "xfeat"])
def test_warm_up_goes_all_the_way_through_a_localization(name):
    done = warm_up(create_matcher(name), "cpu")
    assert done.estimate.status is Status.LOCALIZED, done.estimate.reason
    assert {"features", "render", "match", "track", "solve", "verify"} <= done.estimate.milliseconds.keys()
    assert warm_up(device="cpu").compiled == 0


def test_tool_says_what_it_did(capsys):
    assert warmup.main(["--matcher", "sift"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in lines] == ["kernels", "matcher sift", "a localization in a made-up map"]
    assert "localized" in lines[2]


def test_tool_says_what_is_missing(capsys):
    assert warmup.main(["--matcher", "xfeat", "--weights", "/nowhere/xfeat.pt"]) == 2
    assert "/nowhere/xfeat.pt" in capsys.readouterr().err
