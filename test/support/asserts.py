"""Checks that tests of different parts share."""

from __future__ import annotations

from gsfeatloc_ros.localize.estimate import Estimate, Status


def assert_no_answer(estimate: Estimate) -> None:
    """Check that an estimate has no pose, and says why."""
    assert estimate.status in (Status.FAILED, Status.REJECTED)
    assert not estimate.localized
    assert estimate.T_map_camera is None
    assert estimate.covariance is None
    assert estimate.reason
