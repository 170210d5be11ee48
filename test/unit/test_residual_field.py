"""What residuals near each other have in common, held against fields that are known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsfeatloc_ros.pose.residual_field import ResidualField

SIZE = np.array([640, 480])


def pixels(seed: int, count: int = 400) -> np.ndarray:
    return np.random.default_rng(seed).random((count, 2)) * SIZE


def bend(at: np.ndarray, amplitude: float) -> np.ndarray:
    """Residuals (M, 2) that vary smoothly, half a wave over the photo's height."""
    return amplitude * np.stack([np.sin(at[:, 1] / 150), np.cos(at[:, 0] / 150)], axis=1)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_residuals_have_no_field(count: int) -> None:
    field = ResidualField.of(np.zeros((count, 2)), np.zeros((count, 2)), 3.0)
    assert field == ResidualField(0.0, 0.0, 1.0)
    assert field.bent_variance == 0


@given(st.integers(0, 2**32 - 1))
def test_independent_residuals_have_nothing_in_common(seed: int) -> None:
    at = pixels(seed)
    field = ResidualField.of(at, np.random.default_rng(seed + 1).normal(0, 0.3, at.shape), 3.0)
    assert field.total == pytest.approx(0.09, rel=0.3)
    assert field.smooth < 0.01
    assert field.bent_variance == 0


def test_the_smooth_part_is_the_variance_of_a_bend() -> None:
    at = pixels(0)
    noise = np.random.default_rng(1).normal(0, 0.3, at.shape)
    field = ResidualField.of(at, bend(at, 0.5) + noise, 3.0)
    # Waves of amplitude 0.5, nearly in phase 25 to 60 pixels apart; there are more pairs in the middle, at their crest.
    assert field.smooth == pytest.approx(0.15, rel=0.15)
    assert field.total == pytest.approx(0.5 * (bend(at, 0.5) ** 2).sum(axis=1).mean() + 0.09, rel=0.1)
    assert field.bent_variance == 30


def test_the_pairs_are_those_of_a_plain_loop() -> None:
    at, residuals = pixels(3, 60) / 4, np.random.default_rng(4).normal(0, 1.5, (60, 2))
    smooth = []
    for i in range(60):
        for j in range(60):
            distance, product = np.linalg.norm(at[i] - at[j]), residuals[i] @ residuals[j] / 2
            if 25 <= distance < 60 and max(np.linalg.norm(residuals[i]), np.linalg.norm(residuals[j])) <= 2:
                smooth.append(product)
    field = ResidualField.of(at, residuals, 2.0)
    assert field.smooth == pytest.approx(max(np.mean(smooth), 0))


def test_what_only_neighbours_share_is_no_bend() -> None:
    """As in a blurred photo: clusters 10 pixels wide are off together, each in its own way."""
    rng = np.random.default_rng(5)
    centres, shifts = pixels(6, 80), rng.normal(0, 0.5, (80, 2))
    at = (centres[:, None] + rng.uniform(-5, 5, (80, 5, 2))).reshape(-1, 2)
    field = ResidualField.of(at, np.repeat(shifts, 5, axis=0), 3.0)
    assert field.total > 0.1
    assert field.bent_variance == 0


def test_wrong_matches_are_no_bend() -> None:
    at = pixels(7)
    residuals = np.random.default_rng(8).normal(0, 0.2, at.shape)
    residuals[at[:, 0] < 150] += 8.0
    assert ResidualField.of(at, residuals, 3.0).bent_variance == 0


@given(st.floats(0.0, 2.0), st.floats(1.0, 50.0))
def test_what_all_share_is_the_variance_of_each_over_the_patches(sigma: float, patches: float) -> None:
    """But keypoints are never better than a tenth of a pixel, however well they agree."""
    field = ResidualField(0.0, sigma**2, patches)
    assert field.shared_variance(0.5) == pytest.approx(0.5 * max(sigma, 0.1) ** 2 / patches)


def test_a_smooth_field_is_shared_beyond_that_of_good_maps() -> None:
    assert ResidualField(0.01, 1.0, 20.0).shared_variance(1.0) == pytest.approx(0.05)
    assert ResidualField(0.04, 1.0, 20.0).shared_variance(1.0) == pytest.approx(0.05 + 0.03)
    bent = ResidualField(0.2, 0.3, 20.0)
    assert bent.shared_variance(1.0) == pytest.approx(0.05 * 0.3 + 0.19 + bent.bent_variance)


def test_patches_are_counted_as_if_each_had_as_many_matches() -> None:
    whole = np.stack(np.meshgrid(np.arange(10, 640, 20.0), np.arange(10, 480, 20.0)), axis=-1).reshape(-1, 2)

    def patches(at: np.ndarray) -> float:
        return ResidualField.of(at, np.zeros(at.shape), 3.0).patches

    assert patches(whole) == pytest.approx(48)
    assert patches(whole[whole[:, 0] < 320]) == pytest.approx(24)
    # Where they are does not matter, nor what does not agree.
    assert patches(whole[whole[:, 0] < 320] + [800.0, -160.0]) == pytest.approx(24)
    residuals = np.zeros(whole.shape)
    residuals[whole[:, 0] >= 320] = 5.0
    assert ResidualField.of(whole, residuals, 3.0).patches == pytest.approx(24)
    # Three patches of which one has as many as the others together: 16 / (4 + 1 + 1).
    one_and_two = np.concatenate([np.full((20, 2), 10.0), np.full((10, 2), 100.0), np.full((10, 2), 200.0)])
    assert patches(one_and_two) == pytest.approx(16 / 6)


@given(st.integers(1, 300), st.integers(0, 2**32 - 1))
def test_there_are_no_more_patches_than_matches_or_cells(count: int, seed: int) -> None:
    at = pixels(seed, count)
    cells = len({(int(x // 80), int(y // 80)) for x, y in at})
    field = ResidualField.of(at, np.zeros(at.shape), 3.0)
    assert 1 <= field.patches <= min(count, cells) + 1e-9
