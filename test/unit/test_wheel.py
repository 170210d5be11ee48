"""What is built for pip: an sdist, the wheel that is built of it, and the command in an environment of its own."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PARTS = ("setup.py", "setup.cfg", "pyproject.toml", "package.xml", "README.md", "LICENSE")
FOLDERS = ("gsfeatloc_ros", "config", "launch", "resource")


def run(*command: object, cwd: Path | None = None) -> str:
    # Without what colcon has built: pip would find the package installed there already, and do nothing.
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    words = [str(word) for word in command]
    done = subprocess.run(words, capture_output=True, text=True, timeout=300, cwd=cwd, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """The wheel, built of the sdist alone."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    source.mkdir()
    for name in PARTS:
        shutil.copy(ROOT / name, source)
    for name in FOLDERS:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    run(sys.executable, "setup.py", "-q", "sdist", "-d", folder, cwd=source)
    (sdist,) = folder.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        archive.extractall(folder / "sdist", filter="data")
    (unpacked,) = (folder / "sdist").iterdir()
    run(sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", folder, unpacked)
    (built,) = folder.glob("*.whl")
    return built


@pytest.mark.nightly
def test_the_wheel_has_all_modules_templates_and_what_ros_looks_for(wheel) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    for path in (ROOT / "gsfeatloc_ros").rglob("*"):
        if path.suffix in (".py", ".j2"):
            assert str(path.relative_to(ROOT)) in names
    for name in ("config/localizer.yaml", "launch/localizer.launch.py", "package.xml"):
        assert any(each.endswith(f"share/gsfeatloc_ros/{name}") for each in names), name


@pytest.mark.nightly
def test_in_an_environment_of_its_own_the_command_helps_and_no_common_name_is_taken(wheel, tmp_path) -> None:
    venv.create(tmp_path / "venv", with_pip=False)
    bin_ = tmp_path / "venv" / "bin"
    before = set(bin_.iterdir())
    run(sys.executable, "-m", "pip", "--python", bin_ / "python", "install", "-q", "--no-deps", "--no-index", wheel)
    assert {path.name for path in set(bin_.iterdir()) - before} == {"gsfeatloc", "localizer"}
    assert "usage: gsfeatloc" in run(bin_ / "gsfeatloc", "--help")
