"""Whether a photo shows enough to be localized at all."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gsfeatloc_ros.localize.content import _SHADE, _share_of_one_shade


@given(
    arrays(np.uint8, (6, 10), elements=st.one_of(st.integers(0, 255), st.integers(100, 110))),
    arrays(bool, (6, 10)).filter(np.any),
)
def test_the_share_of_one_shade_is_that_about_the_median(gray: np.ndarray, seen: np.ndarray) -> None:
    levels = gray[seen].astype(float)
    expected = np.mean(np.abs(levels - np.median(levels)) <= _SHADE)
    assert _share_of_one_shade(gray, seen) == expected
