"""Shares and correlations as numbers that may be added."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import logit as scipy_logit

from gsfeatloc_ros.common.doubt import LEAST_DOUBT, fisher_z, logit


@given(st.floats(LEAST_DOUBT, 1 - LEAST_DOUBT))
def test_within_the_doubt_they_are_the_usual_ones(value: float) -> None:
    assert logit(value) == pytest.approx(scipy_logit(value))
    assert np.tanh(fisher_z(value)) == pytest.approx(value)
    assert fisher_z(-value) == -fisher_z(value)


@pytest.mark.parametrize("transform", [logit, fisher_z])
def test_nothing_is_certain(transform) -> None:
    values = transform(np.array([1 - LEAST_DOUBT, 1.0, 2.0, np.nan]))
    assert np.isfinite(values[:3]).all()
    assert len(set(values[:3])) == 1
    assert np.isnan(values[3])
    assert np.isfinite(transform(0.0))
