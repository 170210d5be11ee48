"""What speaks for an answer, and what is made of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from gsfeatloc_ros.common.geometry import make_pose, so3_exp
from gsfeatloc_ros.localize.evidence import (
    Evidence,
    Limits,
    coverage,
    is_uncertain,
    probability_wrong,
    verdict,
    with_mirror,
)
from gsfeatloc_ros.localize.options import LocalizerOptions
from gsfeatloc_ros.localize.prior import Prior
from gsfeatloc_ros.localize.protection import protection_level

GOOD = Evidence(
    corners=800,
    matches=700,
    lifted=600,
    inliers=590,
    inlier_ratio=0.99,
    render_inlier_ratio=0.98,
    explained_inlier_ratio=0.99,
    coverage=0.8,
    correlation=0.95,
    scattered=0.03,
    changed=0.02,
    beyond_map=0.01,
    reprojection_error_px=0.4,
    deviation=1.2,
    blur_px=0.0,
    focal_error=0.002,
    focal_sigma=0.003,
    probability_wrong=0.99e-12,
    passes=2,
    views=3,
)


def test_good_evidence_has_nothing_against_it() -> None:
    assert verdict(GOOD, Limits()) == ()


@pytest.mark.parametrize(
    ("name", "limit", "beyond", "says"),
    [
        ("inliers", 30, 29, "at least 30 needed"),
        ("probability_wrong", 1e-4, 1.01e-4, "wrong with a probability of 0.0001 (at most 0.0001)"),
        ("coverage", 0.1, 0.0999, "at least 10% needed"),
        ("inlier_ratio", 0.8, 0.7949, "79% of the corners agree (at least 80% needed)"),
        ("render_inlier_ratio", 0.8, 0.7949, "79% of the corners agree (at least 80% needed)"),
        ("focal_error", 0.0129, 0.0131, "the focal length fits 1.3 +- 0.3 % longer than calibrated"),
        ("focal_error", -0.0129, -0.0131, "the focal length fits 1.3 +- 0.3 % shorter than calibrated"),
    ],
)
def test_each_limit_is_exact_and_named(name: str, limit: float, beyond: float, says: str) -> None:
    assert verdict(replace(GOOD, **{name: limit}), Limits()) == ()
    (reason,) = verdict(replace(GOOD, **{name: beyond}), Limits())
    assert says in reason


@pytest.mark.parametrize("name", ["inlier_ratio", "render_inlier_ratio"])
def test_of_a_covered_photo_fewer_corners_need_agree(name: str) -> None:
    """Some of what covers it is found by chance."""
    covered = replace(GOOD, changed=0.301)
    assert verdict(replace(covered, **{name: 0.65}), Limits()) == ()
    (reason,) = verdict(replace(covered, **{name: 0.6449}), Limits())
    assert "64% of the corners agree (at least 65% needed)" in reason
    (reason,) = verdict(replace(GOOD, changed=0.3, **{name: 0.65}), Limits())
    assert "65% of the corners agree (at least 80% needed)" in reason


@pytest.mark.parametrize(
    ("deviation", "says"),
    [(8.0001, ", for the pose is 8.0 standard deviations from the prior"), (float("nan"), " without a prior")],
)
def test_a_pose_that_no_prior_expects_must_be_much_surer(deviation: float, says: str) -> None:
    sure = replace(GOOD, probability_wrong=0.99e-12, deviation=deviation)
    assert verdict(sure, Limits()) == ()
    unsure = replace(sure, probability_wrong=1.01e-12)
    (reason,) = verdict(unsure, Limits())
    assert f"(at most 1e-12{says})" in reason
    assert verdict(replace(unsure, deviation=8.0), Limits()) == ()


def test_nobody_stands_on_his_head_without_that_the_prior_says_so() -> None:
    far = replace(GOOD, deviation=8.1)
    for roll in (float("nan"), -90.0, 0.0, 90.0):
        assert verdict(replace(far, roll_deg=roll), Limits()) == ()
    for roll in (-90.1, 180.0):
        (reason,) = verdict(replace(far, roll_deg=roll), Limits())
        assert f"turned by {abs(roll):.0f} degrees about the camera's axis" in reason
        assert verdict(replace(GOOD, roll_deg=roll), Limits()) == ()


@pytest.mark.parametrize(("deviation", "limit"), [(8.0, 0.75), (9.0, 0.15), (float("nan"), 0.4)])
def test_most_of_the_photo_must_be_as_in_the_map(deviation: float, limit: float) -> None:
    assert verdict(replace(GOOD, changed=limit, deviation=deviation), Limits()) == ()
    for changed in (limit + 0.01, float("nan")):
        too_much = replace(GOOD, changed=changed, deviation=deviation)
        (reason,) = verdict(too_much, Limits())
        assert f"of the photo is not as in the map (at most {limit:.0%}" in reason
        # Its mirror image says nothing of that.
        assert verdict(with_mirror(too_much, 1.0), Limits()) == (reason,)


@pytest.mark.parametrize("deviation", [9.0, float("nan")])
def test_the_mirror_image_decides_on_a_pose_that_no_prior_expects(deviation: float) -> None:
    unsure = replace(GOOD, probability_wrong=1e-4, deviation=deviation)
    assert is_uncertain(unsure, Limits())
    nothing, worse, better = (with_mirror(unsure, p) for p in (1.0, 1.01e-2, 0.99e-2))
    assert verdict(nothing, Limits()) == ()
    assert verdict(worse, Limits()) == ()
    (reason,) = verdict(better, Limits())
    assert "(at most 1e-12, for the photo's mirror image fits about as well: is the image flipped?)" in reason
    # It was asked already; it is not to be asked of what is sure, too risky, or refused all the same.
    for decided in (nothing, better, replace(GOOD, deviation=deviation)):
        assert not is_uncertain(decided, Limits())
    for other in (replace(unsure, inliers=5), replace(unsure, probability_wrong=1.01e-4)):
        assert not is_uncertain(other, Limits())
    (reason,) = verdict(with_mirror(replace(unsure, probability_wrong=1.01e-4), 0.5), Limits())
    assert "flipped" not in reason


def test_a_mirror_image_that_fits_better_decides_on_a_pose_that_a_prior_expects() -> None:
    unsure, sure = replace(GOOD, probability_wrong=1e-6), replace(GOOD, probability_wrong=0.99e-8)
    assert is_uncertain(unsure, Limits())
    assert not is_uncertain(sure, Limits())
    assert verdict(with_mirror(unsure, 1.0e-6), Limits()) == ()
    (reason,) = verdict(with_mirror(unsure, 0.9e-6), Limits())
    assert "(at most 1e-08, for the photo's mirror image fits about as well: is the image flipped?)" in reason
    assert verdict(with_mirror(sure, 1e-9), Limits()) == ()


def test_a_photo_whose_mirror_image_fits_nowhere_is_wrong_a_hundred_times_less_likely() -> None:
    unsure = replace(GOOD, probability_wrong=0.99e-2)
    assert is_uncertain(unsure, Limits())
    found_nowhere, fits_worse, fits = (with_mirror(unsure, p) for p in (1.0, 0.991, 0.9))
    assert found_nowhere.probability_wrong == fits_worse.probability_wrong == pytest.approx(0.99e-4)
    assert verdict(found_nowhere, Limits()) == verdict(fits_worse, Limits()) == ()
    assert fits.probability_wrong == unsure.probability_wrong
    assert len(verdict(fits, Limits())) == 1
    too_risky = replace(GOOD, probability_wrong=1.01e-2)
    assert not is_uncertain(too_risky, Limits())
    assert len(verdict(with_mirror(too_risky, 1.0), Limits())) == 1


def test_limits_are_those_that_are_given() -> None:
    limits = Limits(max_risk=1e-6, min_inliers=600, min_coverage=0.9)
    assert len(verdict(GOOD, limits)) == 2
    assert len(verdict(GOOD, replace(limits, max_deviation=1.0))) == 3


def test_no_inliers_are_the_only_reason() -> None:
    (reason,) = verdict(Evidence(corners=5, matches=3, lifted=2), Limits())
    assert "nothing in common: 5 corners in the photo, 3 found in the render, 2 with depth, 0 inliers" in reason


def test_a_probability_that_cannot_be_said_is_a_reason() -> None:
    (reason,) = verdict(replace(GOOD, probability_wrong=float("nan")), Limits())
    assert "probability of nan" in reason


def test_a_photo_that_would_not_show_a_wrong_focal_length_is_no_answer() -> None:
    """A wall from the front looks the same from nearer by a shorter lens; 1 % and 1.5 times 2.67 % are 5 %."""
    assert verdict(replace(GOOD, focal_error=0.0, focal_sigma=0.026), Limits()) == ()
    flat = replace(GOOD, focal_error=0.0, focal_sigma=0.03)
    (reason,) = verdict(flat, Limits())
    assert "a focal length that is 5.5% off would not show in this image (at most 5.0%" in reason
    assert verdict(flat, Limits(max_focal_error=1.0)) == ()
    # What the photo does contradict is told alone.
    (reason,) = verdict(replace(flat, focal_error=-0.1), Limits())
    assert "the focal length fits 10.0 +- 3.0 % shorter" in reason


@pytest.mark.parametrize(
    ("sigma", "most", "most_where_known"), [(0.003, 0.013, 0.013), (0.005, 0.015, 0.015), (0.02, 0.03, 0.06)]
)
def test_a_focal_length_that_is_known_is_not_doubted_for_what_three_deviations_explain(
    sigma: float, most: float, most_where_known: float
) -> None:
    for limits, largest in ((Limits(), most), (Limits(max_focal_error=1.0), most_where_known)):
        for error in (largest, -largest):
            assert verdict(replace(GOOD, focal_error=0.99 * error, focal_sigma=sigma), limits) == ()
            (reason,) = verdict(replace(GOOD, focal_error=1.01 * error, focal_sigma=sigma), limits)
            assert "the focal length fits" in reason


def test_a_camera_that_cannot_be_fitted_is_none() -> None:
    assert verdict(replace(GOOD, focal_error=float("nan"), focal_sigma=float("nan")), Limits()) == ()


def test_numbers_and_texts_have_the_same_names() -> None:
    assert list(GOOD.numbers()) == list(GOOD.texts())
    assert GOOD.numbers()["inlier_ratio"] == 0.99
    texts = GOOD.texts()
    assert (texts["corners"], texts["inlier_ratio"], texts["probability_wrong"]) == ("800", "0.990", "9.9e-13")
    assert Evidence().texts()["correlation"] == "nan"


@given(
    name=st.sampled_from(["explained_inlier_ratio", "correlation", "scattered", "blur_px"]),
    low=st.floats(0.01, 0.98),
    high=st.floats(0.01, 0.98),
)
def test_more_agreement_never_makes_an_answer_less_probable(name: str, low: float, high: float) -> None:
    low, high = sorted((low, high))
    if name in ("scattered", "blur_px"):
        low, high = high, low
    alike, unlike = (probability_wrong(replace(GOOD, **{name: value}), 500.0) for value in (high, low))
    assert alike <= unlike


def test_probabilities_tell_what_was_seen_apart() -> None:
    """As measured: a right answer, one in a photo that is covered by 60 %, lego's best mirror image, a wrong pose."""

    def seen(agreeing: float, correlation: float, scattered: float, blur_px: float = 0.0) -> float:
        evidence = Evidence(
            explained_inlier_ratio=agreeing, correlation=correlation, scattered=scattered, blur_px=blur_px
        )
        return probability_wrong(evidence, 889.0)

    right, covered = seen(0.994, 0.931, 0.008), seen(0.984, 0.891, 0.117)
    mirrored, wrong = seen(0.971, 0.802, 0.094), seen(0.77, 0.5, 0.4)
    assert right < 1e-12 < covered < 1e-4 < 0.01 < mirrored < wrong
    assert wrong > 0.999
    assert np.isnan(probability_wrong(Evidence(), 500.0))


def test_where_detail_is_lost_photo_and_render_must_be_more_alike() -> None:
    """As measured: the mirror image of a photo of lego that is moved by 25 pixels, and a photo of bonsai that is."""
    alike = Evidence(explained_inlier_ratio=0.952, correlation=0.908, scattered=0.097, blur_px=0.0)
    assert probability_wrong(alike, 889.0) < 1e-4
    assert probability_wrong(replace(alike, blur_px=27.0), 889.0) > 0.1
    # The same blur is a wider angle to a shorter lens.
    assert probability_wrong(replace(alike, blur_px=13.5), 444.5) == probability_wrong(
        replace(alike, blur_px=27.0), 889.0
    )
    moved = Evidence(explained_inlier_ratio=0.993, correlation=0.981, scattered=0.013, blur_px=27.0)
    assert probability_wrong(moved, 661.0) < 1e-12


def test_from_where_most_of_the_photo_is_beyond_the_map_its_mirror_image_decides() -> None:
    """A wall seen from behind looks as its mirror image does."""
    for deviation in (9.0, float("nan")):
        seen = replace(GOOD, deviation=deviation, beyond_map=0.25)
        assert verdict(seen, Limits()) == ()
        behind = replace(seen, beyond_map=0.26)
        assert is_uncertain(behind, Limits())
        (reason,) = verdict(behind, Limits())
        assert "(at most 0, for the map shows nothing of 26% of the photo" in reason
        assert verdict(with_mirror(behind, 1.0), Limits()) == ()
        # It was seen to be no mirror image, but not that it is right: the map's edge is not the reason.
        (reason,) = verdict(with_mirror(replace(behind, probability_wrong=1.01e-4), 1.0), Limits())
        assert "(at most 1e-06" in reason
        assert "shows nothing" not in reason
        (reason,) = verdict(with_mirror(behind, 1e-12), Limits())
        assert "is the image flipped?" in reason
    # Where the prior says so, the map may be a small part of the place.
    assert verdict(replace(GOOD, beyond_map=0.9), Limits()) == ()


def test_deviation_counts_standard_deviations_of_the_prior() -> None:
    default = np.diag([0.25] * 3 + [0.04] * 3)
    moved = make_pose(so3_exp(np.array([0.0, 0.4, 0.0])), np.array([0.5, 0.0, 0.0]))
    # A hundredth of the default variance is added.
    assert Prior(np.eye(4), default, default, default).deviation(moved) == pytest.approx(np.sqrt((1 + 4) / 1.01))
    assert Prior(np.eye(4), default, default, default).deviation(np.eye(4)) == 0
    # What a prior claims to know exactly is given a tenth of the default deviation.
    assert Prior(np.eye(4), np.zeros((6, 6)), default, default).deviation(moved) == pytest.approx(
        np.sqrt((1 + 4) / 0.01)
    )


@given(st.floats(-179.0, 179.0), st.floats(0.0, 180.0), st.floats(0.0, 360.0))
def test_roll_is_the_turn_about_the_axis_of_who_looks_the_same_way(roll: float, apart: float, towards: float) -> None:
    assume(abs(apart - 45.0) > 0.01)
    default = np.diag([0.25] * 3 + [0.04] * 3)
    prior = make_pose(so3_exp(np.array([0.3, -1.0, 2.0])), np.array([1.0, 2.0, 3.0]))
    across = np.radians(apart) * np.array([np.cos(np.radians(towards)), np.sin(np.radians(towards)), 0.0])
    pose = prior @ make_pose(so3_exp(across) @ so3_exp(np.array([0.0, 0.0, np.radians(roll)])), np.ones(3))
    found = Prior(prior, default, default, default).roll_deg(pose)
    assert found == pytest.approx(roll, abs=1e-6) if apart < 45.0 else np.isnan(found)


def test_a_prior_knows_the_way_up_if_it_is_sure_about_each_axis() -> None:
    default = LocalizerOptions().prior_covariance()

    def knows(*degrees: float) -> bool:
        turn = so3_exp(np.array([0.3, -0.4, 0.8]))
        covariance = default.copy()
        covariance[3:, 3:] = turn @ np.diag(np.radians(degrees) ** 2) @ turn.T
        return Prior(np.eye(4), covariance, default, default).knows_the_way_up

    assert Prior(np.eye(4), default, default, default).knows_the_way_up
    assert knows(19.0, 19.0, 19.0)
    assert knows(0.0, 0.0, 0.0)
    assert not knows(1.0, 1.0, 21.0)


def test_protection_levels_are_along_the_worst_axis() -> None:
    turn = np.kron(np.eye(2), so3_exp(np.array([0.3, -0.4, 0.8])))
    covariance = turn @ np.diag([0.01, 0.04, 0.0001, 1e-6, 1e-4, 4e-6]) @ turn.T
    level = protection_level(covariance)
    assert (level.radius, level.angle) == pytest.approx((6 * 0.2, 6 * 0.01))
    assert protection_level(np.eye(6) * 100).angle == np.pi


@given(st.lists(st.tuples(st.floats(-0.5, 639.4), st.floats(-0.5, 479.4)), max_size=60))
def test_coverage_counts_the_cells_that_hold_a_pixel(pixels) -> None:
    cells = {(int((x + 0.5) // 80), int((y + 0.5) // 80)) for x, y in pixels}
    assert coverage(np.array(pixels).reshape(-1, 2), 640, 480) == len(cells) / 48


def test_coverage_is_full_when_every_cell_is_hit() -> None:
    x, y = np.meshgrid(np.arange(0, 640, 40), np.arange(0, 480, 40))
    assert coverage(np.column_stack([x.ravel(), y.ravel()]), 640, 480) == 1.0
