"""Fixtures of the tests that talk to a node."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator

import pytest

_FILES = itertools.count()


@pytest.fixture(scope="module", autouse=True)
def ros_domain() -> Iterator[None]:
    """A ROS domain for each file, apart from those of the other worker.

    Shared memory of Fast DDS is named by the domain: a port of it that a node left broken, so that later ones hear
    nothing (github.com/eProsima/Fast-DDS/issues/5053; CI has seen it once), stays where it happened.
    """
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("ROS_DOMAIN_ID", str(1 + (os.getppid() + 50 * worker + next(_FILES)) % 100))
        yield
