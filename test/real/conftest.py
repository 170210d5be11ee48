"""The folders of real maps and scenes; README.md beside this says what they hold and where it comes from."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def scenes() -> Path:
    """Return the folder of the scenes bonsai/ and lego/."""
    return _folder("scenes", "GSFEATLOC_SCENES", "bonsai")


@pytest.fixture(scope="session")
def maps() -> Path:
    """Return the folder of maps as the tools of others wrote them."""
    return _folder("maps", "GSFEATLOC_MAPS", "plush_dog.ply")


@pytest.fixture(scope="session")
def cases() -> Path:
    """Return the folder of what people brought, made after public reports."""
    return _folder("cases", "GSFEATLOC_CASES", "filter_3d.ply")


@pytest.fixture(scope="session")
def real_file(request: pytest.FixtureRequest) -> Callable[[str], Path]:
    """Return the function that finds a file by "scenes/..." or "maps/..."."""

    def find(name: str) -> Path:
        folder, _, rest = name.partition("/")
        return request.getfixturevalue(folder) / rest

    return find


def _folder(name: str, variable: str, sample: str) -> Path:
    """Return the folder that an environment variable names, or the one beside the repository; skip without it."""
    path = Path(os.environ.get(variable) or Path(__file__).parents[3] / "shared" / name)
    if not (path / sample).exists():
        pytest.skip(f"no {sample} in {path}: set {variable} to the folder of the {name} that test/real/README.md lists")
    return path
