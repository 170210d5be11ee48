"""The order in which the splats of a tile are drawn, against numpy's stable sort."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsfeatloc_ros.render.depth_sort import sorted_by_depth


@numba.njit
def _sorted(keys):
    return sorted_by_depth(keys, np.empty(len(keys) + 3, np.uint64)).copy()


def check(depths: np.ndarray) -> None:
    """Hold the order of splats at `depths` (n,) against numpy's."""
    bits = depths.astype(np.float32).view(np.uint32).astype(np.uint64)
    keys = bits << np.uint64(32) | np.arange(len(bits), dtype=np.uint64)[::-1]
    expected = keys[np.argsort(bits, kind="stable")]
    np.testing.assert_array_equal(_sorted(keys.copy()), expected)


def test_no_splats_are_sorted() -> None:
    check(np.empty(0))


# Few depths, so that some are equal.
depths = st.sampled_from([0.01, 1.0, np.nextafter(np.float32(1), np.float32(2)), 1.5, 2.0, 2.1, 300.0])


@settings(max_examples=100, deadline=None)
@given(st.lists(depths | st.floats(1 / 128, 1e6, width=32), max_size=300))
def test_splats_are_sorted_by_depth_and_at_one_depth_kept_in_order(depths: list[float]) -> None:
    check(np.array(depths))


@pytest.mark.parametrize("outliers", [[], [0.011], [1e5], [0.011, 1e5]])
@pytest.mark.parametrize("spread", [0.0, 1e-6, 1e-3, 0.3])
def test_a_wall_seen_through_floaters_is_sorted(outliers: list[float], spread: float) -> None:
    """Far more splats than depths that the highest bits tell apart: moved one by one it would take for ever."""
    rng = np.random.default_rng(0)
    check(rng.permutation(np.concatenate([3 + spread * rng.standard_normal(20_000).clip(-3, 3), outliers])))
