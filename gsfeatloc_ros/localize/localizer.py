"""The pipeline: photo and prior in, pose out."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import islice

import cv2
import numpy as np

from gsfeatloc_ros.common.arrays import to_host
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.photo import Photo
from gsfeatloc_ros.common.stage_clock import OutOfTime, StageClock
from gsfeatloc_ros.index import ViewIndex
from gsfeatloc_ros.localize.blur import Blur, estimate_blur
from gsfeatloc_ros.localize.comparison import changed_mask, compare, preference
from gsfeatloc_ros.localize.content import too_few_features, too_little
from gsfeatloc_ros.localize.estimate import Estimate, Status, Trace
from gsfeatloc_ros.localize.evidence import (
    MUCH_CHANGED,
    Evidence,
    Limits,
    camera_is_in_doubt,
    coverage,
    is_uncertain,
    probability_wrong,
    verdict,
    with_mirror,
)
from gsfeatloc_ros.localize.left_open import picture_shift, poses_left_open
from gsfeatloc_ros.localize.options import LocalizerOptions
from gsfeatloc_ros.localize.prior import Prior
from gsfeatloc_ros.localize.query import Components, MatchedView, Query
from gsfeatloc_ros.localize.search import Search
from gsfeatloc_ros.match import Matcher, Tracker, create_tracker
from gsfeatloc_ros.pose.camera_fit import CameraFit, fit_camera
from gsfeatloc_ros.pose.other_focal_length import STEP_SIGMA, other_focal_lengths
from gsfeatloc_ros.pose.solve import Correspondences, PoseOptions, reprojection_errors, solve_pose
from gsfeatloc_ros.render.base import Renderer

# A render nearer to the photo than this many pixels is at the estimate. Where it is not believed it is looked at from
# nearer: photo and render are a little more alike then.
_MAX_SETTLED_OFFSET, _MAX_DOUBTED_OFFSET = 1.0, 0.5
# With a blur of this extent, in pixels, corners may be off by twice the reprojection error allowed.
_BLUR_THAT_DOUBLES_ERRORS = 25.0
# Matches farther off than this many pixels say nothing of the camera.
_MAX_CAMERA_ERROR = 20.0
# Views of the index that the photo's mirror image is compared with, and suggested poses of it that are followed.
_MIRROR_VIEWS = 24
_MIRROR_POSES = 2
# Features that would move the picture by more pixels than these are followed.
_MAX_FEATURES_SHIFT = 2.0
# Another focal length is the right one if so many times as many corners agree, and so many more.
_CLEARLY_MORE, _LEAST_MORE = 1.2, 10
# Of two places that explain the photo, one is the better if it leads by so many standard deviations of chance.
_MIN_LEAD = 3.0


class Localizer:
    """Finds where a photo was taken, in two steps.

    First small: where the prior is good, the photo's corners are tracked into a small render there. Where it is not, or
    that leads to no answer, features of photo and render are matched. Matches are lifted to 3D by the render's depth
    and solved for the pose. If there is still no answer, or no prior, the index of the map's views tells where else to
    look, and then views around the prior are tried. Then at full size: the photo's corners are tracked to a render at
    the estimate, lifted and solved, until the render is where the photo is.

    That last render is what the estimate is verified by: what the map predicts there must match the photo.
    """

    def __init__(
        self,
        renderer: Renderer,
        matcher: Matcher,
        options: LocalizerOptions | None = None,
        *,
        index: ViewIndex | None = None,
        create_tracker: Callable[[Photo, str], Tracker] = create_tracker,
        now: Callable[[], float] = time.perf_counter,
    ) -> None:
        """Make a localizer.

        Args:
            renderer: of the map.
            matcher: of features.
            options: settings; None for the defaults.
            index: of views of the map, by the matcher's features; without one no photo is found without a prior.
            create_tracker: makes the tracker of a photo for renders on a device.
            now: clock that the stages are measured with, in seconds.
        """
        self._components = Components(renderer, matcher, create_tracker, options or LocalizerOptions(), index)
        self._now = now

    def localize(
        self,
        image: np.ndarray,
        camera: Camera,
        T_map_camera_prior: np.ndarray | None = None,
        prior_covariance: np.ndarray | None = None,
        interrupted: Callable[[], bool] = lambda: False,
    ) -> Estimate:
        """Localize a photo.

        Args:
            image: (H, W, 3) uint8 RGB as the camera gave it, distorted.
            camera: its intrinsics and distortion, of the same size.
            T_map_camera_prior: (4, 4) prior of the camera (optical axes) in the map frame; None for none: the whole
                index is searched.
            prior_covariance: (6, 6) of the prior: what is searched first. In ROS order (x y z, rotation about x y z),
                axes of the map frame, map units and radians. None for that of the options.
            interrupted: whether to give up, asked every few tens of milliseconds.

        Where the options' deadline has passed before there is an answer that nothing speaks against, there is none.

        Raises:
            Interrupted: `interrupted` said so.
            ValueError: the image is not 8-bit RGB of the camera's size, the prior not a finite (4, 4) pose or its
                covariance not a finite (6, 6) matrix.
        """
        return self.trace(image, camera, T_map_camera_prior, prior_covariance, interrupted).estimate

    def trace(
        self,
        image: np.ndarray,
        camera: Camera,
        T_map_camera_prior: np.ndarray | None = None,
        prior_covariance: np.ndarray | None = None,
        interrupted: Callable[[], bool] = lambda: False,
    ) -> Trace:
        """Localize a photo, and keep the pictures that the estimate was made from; otherwise as `localize`."""
        options = self._components.options
        if image.dtype != np.uint8 or image.shape != (camera.height, camera.width, 3):
            raise ValueError(
                f"expected an RGB image {camera.width}x{camera.height} uint8, got shape {image.shape} {image.dtype}"
            )
        prior = Prior.of(T_map_camera_prior, prior_covariance, options)
        clock = StageClock(self._now, interrupted, options.deadline or math.inf)
        with clock.stage("prepare"):
            photo = Photo.undistorted(image, camera, options.max_image_width)

        def plausible(pose: np.ndarray) -> bool:
            return prior is None or prior.deviation(pose) <= options.limits.max_deviation

        query = Query(self._components, photo, clock, plausible)
        search = Search(query, prior, self._now)
        trace = self._search(query, search, prior)
        estimate = replace(trace.estimate, milliseconds=clock.milliseconds())
        return replace(trace, estimate=estimate, searched=tuple(search.poses_looked_from))

    def _search(self, query: Query, search: Search, prior: Prior | None) -> Trace:
        """Look at small views of the map, at the prior and then where else it may be, and refine what they suggest."""
        likeliest: _Candidate | None = None
        try:
            reason = too_little(query)
            if reason:
                return Trace(Estimate(Status.FAILED, reason), query.photo)
            for candidate in self._candidates(query, search, prior):
                if likeliest is None or candidate.evidence.inliers > likeliest.evidence.inliers:
                    likeliest = candidate
                if candidate.believed:
                    best, rivals = self._best(query, candidate, search, prior)
                    return best.trace(query.photo, search, rivals)
                if candidate.only_the_camera_is_in_doubt(self._components.options.limits):
                    return candidate.trace(query.photo, search)
        except OutOfTime:
            return _out_of_time(query, search, likeliest)
        if likeliest is not None:
            return likeliest.trace(query.photo, search)
        return _nothing_in_common(search, query.photo)

    def _candidates(self, query: Query, search: Search, prior: Prior | None) -> Iterator[_Candidate]:
        """Yield what the poses of a search lead to, judged."""
        limits = self._components.options.limits
        mirror_probability_wrong = cache(partial(self._mirror_probability_wrong, query))

        def judged(candidate: _Candidate) -> _Candidate:
            search.tried(candidate.view)
            if query.components.index is not None and is_uncertain(candidate.evidence, limits):
                return candidate.against_mirror(mirror_probability_wrong(), limits)
            return candidate

        for pose in search.poses():
            candidate = judged(self._refine(query, pose, prior))
            if (better := self._explaining_more(query, search, candidate, prior)) is not candidate:
                candidate = judged(better)
            yield self._with_the_focal_length_asked(query, search, candidate)

    def _explaining_more(self, query: Query, search: Search, found: _Candidate, prior: Prior | None) -> _Candidate:
        """Return a candidate, or one on which more corners agree that it leaves open or that features suggest.

        A plane that agrees may leave the rest of the photo so far off that it looks as if it were covered; and what
        looks alike may agree when it should not.
        """
        if not (found.pose and found.is_believed_by_a_part):
            return found
        small, options, seen = search.small, self._components.options, (query.photo.camera, found.view.render)
        poses = poses_left_open(*seen, *found.pose, options.lift)
        matched, small_options = small.match(found.pose[0], same_way_up=True).found, _for_small(query, small)
        with query.clock.stage("verify"):
            by_features = solve_pose(small.photo.camera, matched, small_options, options.seed, small.plausible)
        if by_features:
            pose = by_features.T_map_camera
            if picture_shift(*seen, found.pose[0], pose, options.lift) > _MAX_FEATURES_SHIFT:
                poses.append(pose)
        others = [self._refine(query, pose, prior) for pose in poses if query.plausible(pose)]
        return max(found, *others, key=lambda candidate: candidate.evidence.inliers) if others else found

    def _with_the_focal_length_asked(self, query: Query, search: Search, found: _Candidate) -> _Candidate:
        """Return a candidate, refused if with another focal length many more corners agree."""
        options, small = self._components.options, search.small
        if options.limits.focal_length_is_known or not (found.pose and found.is_believed_by_a_part):
            return found
        matched, small_options = small.match(found.pose[0], same_way_up=True).found, _for_small(query, small)
        with query.clock.stage("verify"):
            others = other_focal_lengths(small.photo.camera, found.pose[0], matched, small_options, small.plausible)
        if not others:
            return found
        # The calibration's as of a render at the estimate, too: the last one may have been beside it.
        inliers = max(found.view.inliers, query.track(found.pose[0]).inliers)
        most, error = max(_CLEARLY_MORE * inliers, inliers + _LEAST_MORE), 0.0
        for other in others:
            view = query.zoomed(other.error).track(other.T_map_camera)
            if view.inliers > most:
                most, error = view.inliers, other.error
        if error == 0.0:
            return found
        evidence = replace(found.evidence, focal_error=error, focal_sigma=STEP_SIGMA)
        return found.judged_by(evidence, options.limits)

    def _best(
        self, query: Query, found: _Candidate, search: Search, prior: Prior | None
    ) -> tuple[_Candidate, list[_Candidate]]:
        """Return the candidate that explains the photo best, `found` or another place, and those that do so equally."""
        equals: list[_Candidate] = []
        for pose in search.rivals(found.view):
            rival = self._refine(query, pose, prior)
            if not (rival.believed or is_uncertain(rival.evidence, self._components.options.limits)):
                continue
            with query.clock.stage("verify"):
                lead = preference(query.photo, found.view, rival.view)
            if lead <= -_MIN_LEAD:
                found, equals = rival, []
            elif lead < _MIN_LEAD:
                equals.append(rival)
        return found, equals

    def _mirror_probability_wrong(self, query: Query) -> float:
        """Return the probability that what the index suggests for the photo's mirror image is wrong; 1 for nothing.

        Nearly symmetric objects explain the mirror images of their photos well, but not as well as the photos.
        """
        options = query.components.options
        few = replace(options, search=replace(options.search, max_views=_MIRROR_VIEWS, skipped=0))
        mirror = Query(replace(query.components, options=few), query.photo.mirrored(), query.clock)
        search = Search(mirror, None, self._now)
        found = []
        for pose in islice(search.poses(), _MIRROR_POSES):
            candidate = self._refine(mirror, pose, None)
            search.tried(candidate.view)
            found.append(candidate.evidence)
        return min((e.probability_wrong for e in found if e.inliers >= options.limits.min_inliers), default=1.0)

    def _refine(self, query: Query, pose: np.ndarray, prior: Prior | None) -> _Candidate:
        """Render and track at `pose`, then at each estimate, until the render is where the photo is; then verify."""
        view, blur = _look(query, pose)
        passes, max_passes = 1, self._components.options.max_passes

        def approach(view: MatchedView, max_offset: float) -> MatchedView:
            nonlocal blur, passes
            while view.solution and view.offset(query.photo.camera) >= max_offset and passes < max_passes:
                view, blur = _look(query, view.solution.T_map_camera)
                passes += 1
            return view

        view = approach(view, _MAX_SETTLED_OFFSET)
        candidate = self._verify(query, view, _counted(query, view, blur, passes), prior)
        if not candidate.believed and (nearer := approach(view, _MAX_DOUBTED_OFFSET)) is not view:
            candidate = self._verify(query, nearer, _counted(query, nearer, blur, passes), prior)
        return candidate

    def _verify(self, query: Query, view: MatchedView, evidence: Evidence, prior: Prior | None) -> _Candidate:
        """Collect what speaks for the pose that the last view gave, and what against it."""
        options, camera = self._components.options, query.photo.camera
        if view.solution is None:
            return _Candidate(view, evidence, None, verdict(evidence, options.limits))
        # In a blurred photo all corners are less certain.
        blurred = min(evidence.blur_px / _BLUR_THAT_DOUBLES_ERRORS, 1.0)
        tolerance = (1.0 + blurred) * options.pose.max_reprojection_error
        pose = view.solution.T_map_camera
        with query.clock.stage("solve"):
            fit = fit_camera(camera, pose, _near(view), options.pose)
        errors = partial(fit.reprojection_errors, camera) if fit else partial(reprojection_errors, camera, pose)
        comparison = compare(query, view, errors, tolerance)
        with query.clock.stage("verify"):
            evidence = replace(
                evidence,
                inlier_ratio=comparison.inlier_ratio,
                render_inlier_ratio=comparison.render_inlier_ratio,
                explained_inlier_ratio=comparison.explained_inlier_ratio,
                coverage=coverage(view.correspondences.a, camera.width, camera.height),
                correlation=comparison.explained_correlation,
                scattered=comparison.scattered,
                changed=comparison.changed,
                beyond_map=comparison.beyond_map,
                reprojection_error_px=view.solution.reprojection_error,
                deviation=prior.deviation(pose) if prior else float("nan"),
                roll_deg=prior.roll_deg(pose) if prior else float("nan"),
                bend_px=float(np.sqrt(fit.field.bent_variance)) if fit else float("nan"),
                focal_error=fit.focal if fit else float("nan"),
                focal_sigma=fit.focal_sigma if fit else float("nan"),
            )
            evidence = replace(evidence, probability_wrong=probability_wrong(evidence, camera.K[0, 0]))
            return _Candidate(view, evidence, fit, verdict(evidence, options.limits))


def _look(query: Query, pose: np.ndarray) -> tuple[MatchedView, Blur | None]:
    """Render and track at a pose (4, 4); blurred as the photo is, if that is so and more corners agree then."""
    view = query.track(pose)
    with query.clock.stage("track"):
        blur = estimate_blur(query.photo.gray(), cv2.cvtColor(to_host(view.image), cv2.COLOR_RGB2GRAY))
    if blur is not None and (blurred := query.track(pose, blur)).inliers >= view.inliers:
        return blurred, blur
    return view, None


def _counted(query: Query, view: MatchedView, blur: Blur | None, passes: int) -> Evidence:
    """Return what there is to count of a view before it is verified."""
    return Evidence(
        corners=len(query.tracker.corners),
        matches=view.matches,
        lifted=len(view.found.pixels),
        inliers=view.inliers,
        blur_px=blur.extent if blur else 0.0,
        passes=passes,
    )


def _for_small(query: Query, small: Query) -> PoseOptions:
    """Return how to solve for the pose of a small photo as exactly as for that of the photo."""
    options = query.components.options.pose
    scale = small.photo.camera.width / query.photo.camera.width
    return replace(options, max_reprojection_error=scale * options.max_reprojection_error)


def _near(view: MatchedView) -> Correspondences:
    """Return the correspondences that may be right if the camera is not as it was calibrated."""
    assert view.solution is not None
    return view.found.select(view.solution.errors <= _MAX_CAMERA_ERROR)


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A pose that a view gave, and whether it is an answer."""

    view: MatchedView
    evidence: Evidence
    camera_fit: CameraFit | None
    reasons_against: tuple[str, ...]

    @property
    def believed(self) -> bool:
        """Whether nothing speaks against it."""
        return not self.reasons_against

    @property
    def is_believed_by_a_part(self) -> bool:
        """Whether nothing speaks against it, but much of the photo is not explained."""
        return self.believed and self.evidence.changed > MUCH_CHANGED

    def only_the_camera_is_in_doubt(self, limits: Limits) -> bool:
        """Return whether nothing but the camera's calibration speaks against it: no other view would help."""
        return len(self.reasons_against) == 1 and camera_is_in_doubt(self.evidence, limits)

    def against_mirror(self, mirror_probability_wrong: float, limits: Limits) -> _Candidate:
        """Return the candidate judged with what is known of the photo's mirror image."""
        return self.judged_by(with_mirror(self.evidence, mirror_probability_wrong), limits)

    def judged_by(self, evidence: Evidence, limits: Limits) -> _Candidate:
        """Return the candidate judged by other evidence."""
        return replace(self, evidence=evidence, reasons_against=verdict(evidence, limits))

    @property
    def pose(self) -> tuple[np.ndarray, np.ndarray] | None:
        """The pose (4, 4) with its covariance (6, 6), by the camera as the photo shows it; None for none."""
        answer = self.camera_fit or self.view.solution
        return (answer.T_map_camera, answer.covariance) if answer else None

    def trace(self, photo: Photo, search: Search, rivals: Sequence[_Candidate] = ()) -> Trace:
        """Return the estimate that this is, after a search, unless `rivals` explain the photo equally well."""
        view, evidence = self.view, search.counted(self.evidence)
        if rivals:
            poses = tuple(c.pose[0] for c in (self, *rivals) if c.pose)
            reason = f"{len(poses)} places explain the photo equally well: send another image, or a prior"
            estimate = Estimate(Status.AMBIGUOUS, reason, evidence=evidence, candidates=poses)
        elif self.reasons_against or self.pose is None:
            reason = f"the pose found is not believed: {self.reasons_against[0]}"
            estimate = Estimate(Status.REJECTED, reason, evidence=evidence)
        else:
            reason = (
                f"{evidence.inliers} inliers of {evidence.lifted} corners, correlation {evidence.correlation:.2f}; "
                f"{evidence.changed:.0%} of the photo is not as in the map"
            )
            if evidence.bend_px > 0:
                reason += "; the corners are off in a smooth pattern: the map is bent there, or the camera another"
            estimate = Estimate(Status.LOCALIZED, reason, *self.pose, evidence)
        changed = partial(changed_mask, photo, view) if view.solution else None
        return Trace(estimate, photo, view.render, view.correspondences, changed)


def _out_of_time(query: Query, search: Search, likeliest: _Candidate | None) -> Trace:
    """Time is up, and there is no answer: say what was looked at, and of the likeliest pose why it is none yet."""
    reason = f"not found within {query.components.options.deadline:.2f} s: looked {search.looked or 'nowhere yet'}"
    if likeliest is None:
        return Trace(Estimate(Status.FAILED, reason, evidence=search.counted(Evidence())), query.photo)
    against = (*likeliest.reasons_against, "other places that may explain the photo were not looked at")[0]
    reason = f"{reason}; the pose found is not believed: {against}"
    estimate = Estimate(Status.REJECTED, reason, evidence=search.counted(likeliest.evidence))
    return replace(likeliest.trace(query.photo, search), estimate=estimate)


def _nothing_in_common(search: Search, photo: Photo) -> Trace:
    """None of the views that were searched suggested a pose; it may be that the map is read wrong."""
    looked, features, reading = search.looked, len(search.small.features), search.small.components.renderer.reading
    reason = too_few_features(search.small)
    if reason:
        return Trace(Estimate(Status.FAILED, reason, evidence=search.counted(Evidence())), photo)
    if search.best is None and not looked:
        reason = "there is neither a prior nor an index of views in which to look without one (index.build)"
        return Trace(Estimate(Status.FAILED, reason, evidence=search.counted(Evidence())), photo)
    other = f". {reading.other}" if reading.other else ""
    if search.best is None:
        reason = f"nothing {looked} suggests a pose: {features} features in the photo{other}"
        return Trace(Estimate(Status.FAILED, reason, evidence=search.counted(Evidence())), photo)
    best = search.best
    evidence = Evidence(matches=best.matches, lifted=len(best.found.pixels), inliers=best.inliers)
    reason = (
        f"photo and renders have nothing in common {looked}: {features} features in the photo, at best {best.matches} "
        f"matches, {len(best.found.pixels)} with depth, {best.inliers} inliers{other}"
    )
    return Trace(Estimate(Status.FAILED, reason, evidence=search.counted(evidence)), photo, best.render)
