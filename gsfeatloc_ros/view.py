"""One view of the map compared with the photo: the step that localization repeats."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsfeatloc_ros.camera import Camera
from gsfeatloc_ros.match.base import Features, Matcher, Matches
from gsfeatloc_ros.pose.lift import lift
from gsfeatloc_ros.pose.solve import PoseSolution, solve_pose
from gsfeatloc_ros.render.base import Render, Renderer
from gsfeatloc_ros.timing import StageClock


@dataclass(frozen=True, eq=False)
class MatchedView:
    """A view, matched with the photo and solved.

    Attributes:
        render: the map as seen there.
        matches: how many the matcher found.
        lifted_matches: those whose render pixel has a depth.
        points: (M, 3) map points of `lifted_matches`.
        solution: the photo's pose from them, None where they agree on none.
    """

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
    """Render the map at `pose`, match the render with the photo, lift the matches and solve for the photo's pose.

    Args:
        renderer, matcher: of the map and of features.
        query: features of the photo, as observed (distorted).
        camera: of the photo; the render is a pinhole camera's with the same K.
        pose: (4, 4) T_map_camera of the view.
        max_error: reprojection error in pixels up to which a match agrees with a pose.
        seed: of RANSAC.
        clock: on which the stages are counted.
    """
    with clock.stage("render"):
        render = renderer.render(camera, pose)
    with clock.stage("features"):
        features = matcher.features(render.image())
    with clock.stage("match"):
        matches = matcher.match(query, features)
    with clock.stage("solve"):
        lifted = lift(render, camera, pose, matches.b)
        lifted_matches = matches.select(lifted.valid)
        points, sigmas = lifted.points[lifted.valid], lifted.sigmas[lifted.valid]
        solution = solve_pose(camera, camera.undistort(lifted_matches.a), points, sigmas, max_error, seed)
    return MatchedView(render, len(matches), lifted_matches, points, solution)
