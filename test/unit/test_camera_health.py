"""What many images tell of their camera's calibration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.localize.estimate import Estimate, Status
from gsfeatloc_ros.localize.evidence import Evidence, Limits, verdict
from gsfeatloc_ros.ros_io.camera_health import CameraHealth

CAMERA = Camera(640, 480, np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]]), np.zeros(5))
GOOD = Evidence(
    inliers=500,
    inlier_ratio=0.99,
    render_inlier_ratio=0.99,
    coverage=0.9,
    correlation=0.9,
    scattered=0.1,
    changed=0.0,
    deviation=1.0,
    focal_error=0.0,
    focal_sigma=0.003,
    probability_wrong=1e-9,
)


def read(error: float, sigma: float = 0.003) -> Estimate:
    """An answer with a reading of the focal length."""
    return Estimate(Status.LOCALIZED, "", evidence=replace(GOOD, focal_error=error, focal_sigma=sigma))


def filled(errors, sigma: float = 0.003) -> CameraHealth:
    health = CameraHealth()
    for error in errors:
        health.take(CAMERA, read(error, sigma))
    return health


def test_nothing_is_known_without_readings():
    health = CameraHealth()
    assert health.warning == ""
    assert health.texts() == {"focal_error": "nan", "focal_sigma": "nan", "focal_answers": "0"}
    health.take(CAMERA, Estimate(Status.FAILED, "nothing in common"))
    health.take(CAMERA, read(float("nan"), float("nan")))
    assert health.focal_length.count == 0


def test_one_reading_is_what_it_is():
    focal = filled([0.004], 0.003).focal_length
    assert (focal.error, focal.sigma, focal.count) == (pytest.approx(0.004), pytest.approx(0.003), 1)


def test_better_readings_count_more():
    health = CameraHealth()
    health.take(CAMERA, read(0.01, 0.001))
    health.take(CAMERA, read(0.0, 0.002))
    assert health.focal_length.error == pytest.approx(0.008)


@pytest.mark.parametrize("scatter", [0.5, 1.0, 4.0])
def test_its_deviation_is_that_of_the_mean(scatter):
    """Readings that scatter more than they claim: the deviation of many means of 25 is as large as is said."""
    rng = np.random.default_rng(0)
    focals = [filled(0.02 + scatter * rng.normal(0, 0.003, 25)).focal_length for _ in range(300)]
    actual = np.std([focal.error for focal in focals])
    claimed = np.mean([focal.sigma for focal in focals])
    assert claimed == pytest.approx(max(actual, 0.003 / 5), rel=0.15)


@pytest.mark.parametrize(("error", "way"), [(0.02, "longer"), (-0.02, "shorter")])
def test_a_wrong_calibration_is_named(error, way):
    health = filled([error] * 40, 0.019)
    fits = 500 * (1 + error)
    assert health.warning == (
        f"the focal length fits 2.0 +- 0.3 % {way} than camera_info says, by 40 answers (fx {fits:.1f}, fy {fits:.1f}, "
        "not 500.0, 500.0): is camera_info of this stream?"
    )
    assert health.texts() == {"focal_error": f"{error:.4f}", "focal_sigma": "0.0030", "focal_answers": "40"}


@pytest.mark.parametrize(
    ("errors", "sigma"),
    [
        ([0.02] * 9, 0.001),  # too few
        ([0.011] * 1000, 0.003),  # too small
        ([0.02] * 10, 0.012),  # too uncertain: 5.3 standard deviations
        ([0.0, 0.04] * 10, 0.003),  # contradictory
    ],
)
def test_what_is_not_sure_is_no_warning(errors, sigma):
    assert filled(errors, sigma).warning == ""


def test_it_starts_anew_with_another_calibration():
    health = filled([0.02] * 40)
    # The same in another message.
    health.take(replace(CAMERA, K=CAMERA.K.copy()), read(0.02))
    assert health.focal_length.count == 41
    for other in (
        replace(CAMERA, K=CAMERA.K * [[1.02], [1.02], [1.0]]),
        replace(CAMERA, distortion=np.array([0.1, 0, 0, 0, 0])),
        CAMERA,
    ):
        health.take(other, read(0.0))
        assert health.focal_length.count == 1
        assert health.warning == ""


def test_images_that_are_refused_for_the_focal_length_count():
    evidence = replace(GOOD, focal_error=0.05, probability_wrong=0.3)
    (focal, *others) = verdict(evidence, Limits())
    assert "focal length" in focal
    assert others
    health = CameraHealth()
    for _ in range(10):
        health.take(CAMERA, Estimate(Status.REJECTED, focal, evidence=evidence))
    assert "the focal length fits 5.0 +- 0.1 % longer than camera_info says, by 10 answers" in health.warning


def test_images_that_are_refused_for_other_reasons_do_not_count():
    health = CameraHealth()
    for evidence in (replace(GOOD, focal_error=0.005, probability_wrong=0.3), replace(GOOD, coverage=0.0)):
        assert verdict(evidence, Limits())
        health.take(CAMERA, Estimate(Status.REJECTED, "", evidence=evidence))
    assert health.focal_length.count == 0


def test_the_newest_readings_count():
    """A lens that was refocused."""
    assert filled([0.02] * 1000 + [0.0] * 1000).focal_length.error == 0.0


def test_a_right_calibration_is_confirmed_by_some_readings():
    rng = np.random.default_rng(0)
    right = list(0.003 * rng.normal(size=30))
    assert filled(right).confirms(CAMERA)
    assert not filled(right[:9]).confirms(CAMERA)
    assert not filled([]).confirms(CAMERA)
    # Readings that know little.
    assert not filled(right, sigma=0.03).confirms(CAMERA)
    assert not filled(right).confirms(replace(CAMERA, distortion=np.array([0.1, 0, 0, 0, 0])))


@pytest.mark.parametrize("error", [-0.02, 0.012, 0.05])
def test_a_wrong_calibration_is_not_confirmed(error):
    assert not filled([error] * 100, sigma=0.003).confirms(CAMERA)


def test_a_lens_that_was_refocused_is_confirmed_no_more_after_some_images():
    assert not filled([0.0] * 1000 + [0.05] * 3).confirms(CAMERA)
