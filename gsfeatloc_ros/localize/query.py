"""One photo compared with views of the map: the step that localization repeats."""

from __future__ import annotations

from collections.abc import Callable, Sized
from dataclasses import dataclass, field, replace
from functools import cached_property

import cv2
import numpy as np

from gsfeatloc_ros.common.arrays import Array, to_host
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import invert, transform
from gsfeatloc_ros.common.photo import Photo
from gsfeatloc_ros.common.stage_clock import StageClock
from gsfeatloc_ros.index import Nearest, ViewIndex
from gsfeatloc_ros.localize.blur import Blur
from gsfeatloc_ros.localize.options import LocalizerOptions
from gsfeatloc_ros.match.base import Features, Matcher, Matches, Tracker
from gsfeatloc_ros.pose.lift import Lift, Lifted
from gsfeatloc_ros.pose.parallax import lifting
from gsfeatloc_ros.pose.readout import at_middle_row
from gsfeatloc_ros.pose.solve import Correspondences, PoseSolution, solve_near, solve_pose
from gsfeatloc_ros.render.base import Render, Renderer

# Corners that are followed where the way is long.
_ENOUGH_CORNERS = 200


@dataclass(frozen=True, eq=False)
class MatchedView:
    """A view of the map, matched with the photo and solved.

    Attributes:
        pose: (4, 4) T_map_camera of the view.
        render: the map as seen there.
        image: (H, W, 3) uint8 RGB of it, as it was matched: blurred as the photo is.
        matches: number of the photo's pixels that were found in the render.
        lifted_matches: those whose render pixel has a depth.
        found: these with the points of the map.
        solution: the photo's pose from them, None where they agree on none.
        lift: finds the points of the map under other pixels (N, 2) of the render.
    """

    pose: np.ndarray
    render: Render
    image: Array
    matches: int
    lifted_matches: Matches
    found: Correspondences
    solution: PoseSolution | None
    lift: Lift

    @property
    def inliers(self) -> int:
        """Number of lifted matches that agree with the solution."""
        return int(self.solution.inliers.sum()) if self.solution else 0

    @property
    def correspondences(self) -> Matches:
        """The matches that agree with the solution; none without one."""
        return self.lifted_matches.select(self.solution.inliers) if self.solution else Matches.none()

    def offset(self, camera: Camera) -> float:
        """Return how far, in pixels, this view is from the photo's; infinite without a solution.

        It is the median distance between where the inliers' points are seen from here and from the solution.
        """
        if self.solution is None:
            return float("inf")
        points = self.found.points[self.solution.inliers]
        here, there = (camera.project(transform(invert(T), points)) for T in (self.pose, self.solution.T_map_camera))
        return float(np.median(np.linalg.norm(here - there, axis=1)))


@dataclass(frozen=True, eq=False)
class Components:
    """What localizers are made of.

    Attributes:
        renderer: of the map.
        matcher: of features.
        create_tracker: makes the tracker of a photo for renders that lie on a device.
        options: settings.
        index: of views of the map, by the matcher's features; None where there is none.
    """

    renderer: Renderer
    matcher: Matcher
    create_tracker: Callable[[Photo, str], Tracker]
    options: LocalizerOptions
    index: ViewIndex | None = None


@dataclass
class _LastRender:
    """What was rendered last, and from which pose (4, 4); what lifts its pixels and what features say, if asked."""

    pose: np.ndarray = field(default_factory=lambda: np.eye(4))
    render: Render | None = None
    lift: Lift | None = None
    # By `same_way_up`.
    matched: dict[bool, MatchedView] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Query:
    """A photo that is being localized.

    Attributes:
        components: what it is localized with.
        photo: without distortion, of the size at which it is compared.
        clock: counts the time of the stages.
        plausible: whether a pose (4, 4) may be the photo's, by what was known before.
    """

    components: Components
    photo: Photo
    clock: StageClock
    plausible: Callable[[np.ndarray], bool] = lambda pose: True

    def limited(self, max_width: int) -> Query:
        """Return the query of the same photo, at most `max_width` pixels wide."""
        return replace(self, photo=self.photo.limited(max_width))

    def zoomed(self, error: float) -> Query:
        """Return the query of the same photo as if its focal length were longer by this share; its corners are kept."""
        components = replace(self.components, create_tracker=lambda photo, device: self.tracker)
        return replace(self, components=components, photo=self.photo.zoomed(error))

    @cached_property
    def features(self) -> Sized:
        """The photo's features, as the matcher gives them."""
        with self.clock.stage("features"):
            return self.components.matcher.features(self.photo.image)

    @cached_property
    def nearest(self) -> Nearest:
        """What of the index looks like the photo's features; there is an index, and these have descriptors."""
        index, features = self.components.index, self.features
        assert index is not None
        assert isinstance(features, Features)
        with self.clock.stage("search"):
            return index.nearest(features.on_host())

    @cached_property
    def tracker(self) -> Tracker:
        """The tracker of the photo's corners."""
        with self.clock.stage("track"):
            return self.components.create_tracker(self.photo, self.components.renderer.device)

    def match(self, pose: np.ndarray, same_way_up: bool) -> MatchedView:
        """Render the map at a pose (4, 4), match its features with the photo's, lift the matches and solve.

        Unless that is what was done last. Where the photo is known to be the `same_way_up` as the render, other matches
        are left out: a thing and its like upside down are told apart.
        """
        matcher, photo_features, render = self.components.matcher, self.features, self.render(pose)
        if same_way_up in self._last_render.matched:
            return self._last_render.matched[same_way_up]
        with self.clock.stage("features"):
            image = render.device_image()
            features = matcher.features(image)
        with self.clock.stage("match"):
            matches = matcher.match(photo_features, features, same_way_up)
        view = self._solve(pose, render, image, matches)
        self._last_render.matched[same_way_up] = view
        return view

    def track(self, pose: np.ndarray, blur: Blur | None = None) -> MatchedView:
        """Do the same where the pose is nearly the photo's: track the photo's corners to the render instead.

        Corners that cannot be lifted are left out. The render is blurred by `blur`, as the photo is; None for a sharp
        one.
        """
        tracker, render, lift = self.tracker, self.render(pose), self._lift(pose)
        with self.clock.stage("track"):
            image = _blurred(render, blur)
            matches = tracker.track(image, lambda pixels: lift(pixels).valid)
        return self._solve(pose, render, image, matches)

    def track_from_afar(self, pose: np.ndarray) -> MatchedView:
        """Do the same where the pose may be some way off: with fewer corners, which need not be where depth is."""
        tracker, render = self.tracker, self.render(pose)
        with self.clock.stage("track"):
            image = render.device_image()
            matches = tracker.track(image, _some)
        return self._solve(pose, render, image, matches)

    def correspondences(self, pixels: np.ndarray, lifted: Lifted, pose: np.ndarray) -> Correspondences:
        """Return pixels (M, 2) of the photo with the points of the map there, where these could be lifted.

        The pose (4, 4) is the one at which they were: without the motion of a rolling shutter they are seen from there.
        """
        kept = lifted.valid
        found = Correspondences(pixels[kept], lifted.points[kept], lifted.sigmas[kept])
        return at_middle_row(self.photo.camera, pose, found)

    def render(self, pose: np.ndarray) -> Render:
        """Render the map at a pose (4, 4), unless that is what was rendered last."""
        last = self._last_render
        if last.render is None or not np.array_equal(last.pose, pose):
            with self.clock.stage("render"):
                last.render = self.components.renderer.render(self.photo.camera, pose)
            last.pose, last.lift, last.matched = pose.copy(), None, {}
        return last.render

    def _lift(self, pose: np.ndarray) -> Lift:
        """Return what lifts pixels of the render at a pose (4, 4)."""
        render, last, components = self.render(pose), self._last_render, self.components
        if last.lift is None:
            with self.clock.stage("render"):
                last.lift = lifting(components.renderer, render, self.photo.camera, pose, components.options.lift)
        return last.lift

    @cached_property
    def _last_render(self) -> _LastRender:
        return _LastRender()

    def _solve(self, pose: np.ndarray, render: Render, image: Array, matches: Matches) -> MatchedView:
        options, camera, lift = self.components.options, self.photo.camera, self._lift(pose)
        with self.clock.stage("solve"):
            lifted = lift(matches.b)
            lifted_matches = matches.select(lifted.valid)
            found = self.correspondences(matches.a, lifted, pose)
            solution = solve_near(camera, pose, found, options.pose)
            if solution is None or not self.plausible(solution.T_map_camera):
                solution = solve_pose(camera, found, options.pose, options.seed, self.plausible)
        return MatchedView(pose, render, image, len(matches), lifted_matches, found, solution, lift)


def _blurred(render: Render, blur: Blur | None) -> Array:
    """Return the picture (H, W, 3) of a render, with this blur."""
    image = render.device_image()
    return image if blur is None else cv2.filter2D(to_host(image), -1, blur.kernel)


def _some(pixels: np.ndarray) -> np.ndarray:
    """Return which of pixels (N, 2) are enough to follow where they are all over the picture: (N,) bool."""
    return np.arange(len(pixels)) % -(-len(pixels) // _ENOUGH_CORNERS or 1) == 0
