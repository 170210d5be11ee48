"""What came of an image, as the node and replay say it."""

from __future__ import annotations

import numpy as np
import pytest

from gsfeatloc_ros.localize.estimate import Estimate, Status
from gsfeatloc_ros.ros_io.outcome import Outcome, OutcomeStatus
from gsfeatloc_ros.ros_io.state import Decision, Judgement


@pytest.mark.parametrize("status", Status)
def test_an_estimate_is_an_outcome_of_the_same_status(status):
    estimate = Estimate(status, "so", np.eye(4), np.eye(6))
    outcome = Outcome.of(estimate)
    assert (outcome.status.value, outcome.reason, outcome.estimate) == (status.value, "so", estimate)
    assert outcome.localized == estimate.localized


def test_what_was_not_tried_has_no_estimate():
    refused = Outcome.refused(ValueError("no prior yet"))
    assert (refused.status, refused.reason, refused.estimate) == (OutcomeStatus.REFUSED, "no prior yet", None)
    assert not refused.localized


def test_a_bug_is_an_error_and_no_refusal():
    error = Outcome.error(MemoryError("no room"))
    assert (error.status, error.reason, error.estimate) == (OutcomeStatus.ERROR, "MemoryError: no room", None)
    assert not error.localized


def test_an_answer_to_be_confirmed_is_none_yet():
    estimate = Estimate(Status.LOCALIZED, "30 inliers", np.eye(4), np.eye(6))
    unconfirmed = Outcome.of(estimate, Judgement(Decision.AWAIT, "the next image has to agree"))
    assert (unconfirmed.status, unconfirmed.estimate) == (OutcomeStatus.UNCONFIRMED, estimate)
    assert unconfirmed.reason == "the next image has to agree: 30 inliers"
    assert not unconfirmed.localized
