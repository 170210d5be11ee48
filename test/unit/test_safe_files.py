"""Files that others may have put there, and files that are written where others may write."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import gsfeatloc_ros
from gsfeatloc_ros.common.replaced_file import replaced_file
from gsfeatloc_ros.common.safe_files import open_own, open_regular


@pytest.fixture
def path(tmp_path) -> Path:
    (tmp_path / "file").write_bytes(b"content")
    (tmp_path / "file").chmod(0o644)
    return tmp_path / "file"


def write(path: Path, content: bytes = b"new") -> None:
    with replaced_file(path) as stream:
        stream.write(content)


def test_own_files_are_opened(path):
    for opened in (open_own(path), open_regular(path)):
        with opened as stream:
            assert stream.read() == b"content"
            assert not os.get_inheritable(stream.fileno())


def test_what_others_can_have_written_is_not_opened(path, untrusted):
    says = untrusted(path)
    with pytest.raises(OSError) as refusal:  # noqa: PT011
        open_own(path)
    assert says in str(refusal.value)


@pytest.mark.parametrize("path", ["/dev/zero", "/", "/dev/null", "/dev/tty"])
def test_what_is_no_file_is_not_opened(path):
    for opened in (open_own, open_regular):
        with pytest.raises(OSError):  # noqa: PT011
            opened(Path(path))


def test_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OSError, match="is not a regular file"):
        open_regular(tmp_path / "pipe")


def test_no_descriptor_is_left_open(path, untrusted):
    untrusted(path)
    before = os.listdir("/proc/self/fd")
    for _ in range(10):
        with pytest.raises(OSError):  # noqa: PT011
            open_own(path)
    assert len(os.listdir("/proc/self/fd")) == len(before)


@pytest.mark.parametrize("umask", [0o000, 0o002, 0o077])
def test_what_is_written_can_be_trusted_whatever_the_umask(path, umask):
    before = os.umask(umask)
    try:
        write(path)
    finally:
        os.umask(before)
    with open_own(path) as stream:
        assert stream.read() == b"new"


def test_a_link_at_the_file_is_replaced_and_not_followed(path):
    link = path.with_name("link")
    link.symlink_to(path)
    write(link)
    assert path.read_bytes() == b"content"
    assert not link.is_symlink()


@pytest.mark.parametrize("make", [Path.mkdir, lambda path: path.symlink_to("/dev/full")], ids=["folder", "device"])
def test_a_folder_or_a_device_is_not_replaced(path, make):
    """Root could put a file in the place of /dev/full."""
    other = path.with_name("other")
    make(other)
    before = other.lstat()
    with pytest.raises(OSError, match=r"is a device|Is a directory"):
        write(other)
    assert other.lstat().st_ino == before.st_ino
    assert {file.name for file in path.parent.iterdir()} == {"file", "other"}


def test_a_file_that_cannot_be_written_is_named_and_not_its_name_of_chance():
    with pytest.raises(OSError, match=r"'/proc/nothing'$"), replaced_file(Path("/proc/nothing")):
        pass


def test_no_name_can_be_planted(path):
    """A file in progress has a name that cannot be known, and is made anew, never opened."""
    names = set()
    for _ in range(5):
        with replaced_file(path):
            names |= set(os.listdir(path.parent)) - {path.name}
    assert len(names) == 5
    assert os.listdir(path.parent) == [path.name]


LEAVE = """
import os, sys
from pathlib import Path
from gsfeatloc_ros.common.replaced_file import replaced_file
with replaced_file(Path(sys.argv[1])) as stream:
    stream.write(b"half")
    os.kill(os.getpid(), 9)
"""


def test_what_a_killed_process_left_is_cleaned_and_what_one_writes_is_not(path):
    package = Path(gsfeatloc_ros.__file__).parents[1]
    subprocess.run([sys.executable, "-c", LEAVE, str(path)], check=False, cwd=package)
    (leftover,) = set(os.listdir(path.parent)) - {path.name}
    with replaced_file(path) as slow:
        assert leftover not in os.listdir(path.parent)
        write(path, b"quick")
        slow.write(b"slow")
    assert path.read_bytes() == b"slow"
    assert os.listdir(path.parent) == [path.name]
