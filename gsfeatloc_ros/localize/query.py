"""One view of the map compared with the photo: the step that localization repeats."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import invert, transform
from gsfeatloc_ros.common.stage_clock import StageClock
from gsfeatloc_ros.match.base import Features, Matcher, Matches, Tracker
from gsfeatloc_ros.pose.lift import lift
from gsfeatloc_ros.pose.solve import PoseSolution, solve_pose
from gsfeatloc_ros.render.base import Render, Renderer


@dataclass(frozen=True, eq=False)
class MatchedView:
    """A view, matched with the photo and solved.

    Attributes:
        pose: (4, 4) T_map_camera of the view.
        render: the map as seen there.
        matches: how many pixels of the photo were found in the render.
        lifted_matches: those whose render pixel has a depth.
        points: (M, 3) map points of `lifted_matches`.
        solution: the photo's pose from them, None where they agree on none.
    """

    pose: np.ndarray
    render: Render
    matches: int
    lifted_matches: Matches
    points: np.ndarray
    solution: PoseSolution | None

    @property
    def inliers(self) -> int:
        """Number of lifted matches that agree with the solution."""
        return int(self.solution.inliers.sum()) if self.solution else 0

    @property
    def correspondences(self) -> Matches:
        """The matches (inliers) that agree with the solution, which must exist."""
        return self.lifted_matches.select(self.solution.inliers)

    def offset(self, camera: Camera) -> float:
        """How far, in pixels, this view is from the photo's: the median distance between the inliers here and there.

        The solution must exist.
        """
        points = self.points[self.solution.inliers]
        here, there = (camera.project(transform(invert(T), points)) for T in (self.pose, self.solution.T_map_camera))
        return float(np.median(np.linalg.norm(here - there, axis=1)))


def match_view(
    renderer: Renderer,
    matcher: Matcher,
    query: Features,
    camera: Camera,
    pose: np.ndarray,
    max_error: float,
    seed: int,
    clock: StageClock,
) -> MatchedView:
    """Render the map at `pose`, match its features with the photo's, lift the matches and solve for the photo's pose.

    Args:
        renderer, matcher: of the map and of features.
        query: features of the photo.
        camera: of the photo, without distortion.
        pose: (4, 4) T_map_camera of the view.
        max_error: reprojection error in pixels up to which a match agrees with a pose.
        seed: of RANSAC.
        clock: on which the stages are counted.
    """
    with clock.stage("render"):
        render = renderer.render(camera, pose)
    with clock.stage("features"):
        features = matcher.features(render.device_image())
    with clock.stage("match"):
        matches = matcher.match(query, features)
    return _solve_view(render, matches, camera, pose, max_error, seed, clock)


def track_view(
    renderer: Renderer,
    tracker: Tracker,
    camera: Camera,
    pose: np.ndarray,
    max_error: float,
    seed: int,
    clock: StageClock,
) -> MatchedView:
    """The same where `pose` is nearly the photo's: the photo's corners are tracked to the render, not matched."""
    with clock.stage("render"):
        render = renderer.render(camera, pose)
    with clock.stage("track"):
        matches = tracker.track(render.device_image())
    return _solve_view(render, matches, camera, pose, max_error, seed, clock)


def _solve_view(
    render: Render, matches: Matches, camera: Camera, pose: np.ndarray, max_error: float, seed: int, clock: StageClock
) -> MatchedView:
    with clock.stage("solve"):
        lifted = lift(render, camera, pose, matches.b)
        lifted_matches = matches.select(lifted.valid)
        points, sigmas = lifted.points[lifted.valid], lifted.sigmas[lifted.valid]
        solution = solve_pose(camera, lifted_matches.a, points, sigmas, max_error, seed)
    return MatchedView(pose, render, len(matches), lifted_matches, points, solution)
