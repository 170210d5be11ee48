"""Follows the robot from image to image: what each starts from, and what becomes of its answer."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.localize.estimate import Estimate
from gsfeatloc_ros.localize.options import MAX_SEED, LocalizerOptions
from gsfeatloc_ros.ros_io.camera_health import CameraHealth
from gsfeatloc_ros.ros_io.decode import frame_name, nanoseconds
from gsfeatloc_ros.ros_io.inputs import Inputs, LocalizerInput, NewestInputs
from gsfeatloc_ros.ros_io.message_types import AnyImage, Header
from gsfeatloc_ros.ros_io.prior import Prior, PriorSource
from gsfeatloc_ros.ros_io.state import Attempt, Decision, Judgement, LocalizationState, is_unattested

# A camera that went no farther, in metres, and turned no more, in radians, sees about the same.
_SAME_VIEW = (0.15, math.radians(4.5))


class Follower:
    """Chooses what images start from, and judges answers; for the worker's thread, `lose` for any.

    Args:
        inputs: what images are localized with.
        state: where the robot stands.
        track: whether the next image goes on from an answer.

    Attributes:
        images_come: whether they come by themselves: then one may confirm another.
        camera: what is known of their camera's calibration.
    """

    def __init__(self, inputs: Inputs, state: LocalizationState, track: bool) -> None:
        self._inputs, self.state, self._track = inputs, state, track
        self.images_come = True
        self.camera = CameraHealth()
        # Of the images that come by themselves.
        self._camera_frame: str | None = None
        # Views of the index that were looked at in vain, and the stamp of the image from whose place they were.
        self._looked_at, self._looked_from = 0, 0

    def for_image(
        self,
        message: AnyImage,
        camera: Camera | None = None,
        prior: Prior | None = None,
        inputs: NewestInputs | None = None,
    ) -> LocalizerInput:
        """Return what to localize an image with; arguments and errors as of `Inputs.for_image`."""
        query = self._inputs.for_image(message, camera, prior, inputs)
        if self.state.outgrown(query.source, query.prior_covariance):
            self._inputs.forget_answer()
            query = self._inputs.for_image(message, camera, prior, inputs and inputs.without_prior())
        return query

    def options(self, options: LocalizerOptions, header: Header, query: LocalizerInput) -> LocalizerOptions:
        """Return the options for the next image, of this header: what was searched in vain is searched otherwise.

        That is with another seed, and in other views of the index until the camera has moved. Once many images have
        shown that the focal length is right, one need not show it any more.

        Args:
            options: of the localizer.
            header: of the image.
            query: what it is localized with.
        """
        skipped = self._looked_at if self._is_where_it_looked(header) else 0
        seed = (options.seed + self.state.failures) % (MAX_SEED + 1)
        search = replace(options.search, skipped=skipped, usual_covariance=query.usual_covariance)
        limits = options.limits
        if self.camera.confirms(query.camera):
            limits = replace(limits, max_focal_error=1.0)
        return replace(options, seed=seed, search=search, limits=limits)

    def take(self, query: LocalizerInput, header: Header, estimate: Estimate) -> Judgement:
        """Take what came of an image that came by itself, and return what is to be done.

        Args:
            query: what the image was localized with.
            header: of the image.
            estimate: the answer, or none.
        """
        T_map_camera = estimate.T_map_camera
        self.camera.take(query.camera, estimate)
        self._note_search(header, estimate)
        self._camera_frame = frame_name(header.frame_id)
        attempt = Attempt(
            query.source, query.T_map_camera_prior, query.prior_covariance, T_map_camera, self._confirmable(header)
        )
        judgement = self.state.take(attempt)
        if judgement.decision is Decision.FORGET:
            self._inputs.forget_answer()
        elif T_map_camera is not None:
            awaited = judgement.decision is Decision.AWAIT
            self._go_on(query, header, T_map_camera, PriorSource.UNCONFIRMED if awaited else PriorSource.LAST_ANSWER)
        return judgement

    def take_requested(self, query: LocalizerInput, header: Header, T_map_camera: np.ndarray) -> None:
        """Let the images that come by themselves go on from the answer to one that came with a request.

        They do not if it is older than what they have, or of another camera.
        """
        newest, stamp = query.newest_prior, nanoseconds(header.stamp)
        if newest is not None and newest.source.own and newest.stamp > stamp:
            return
        if self._camera_frame not in (None, frame_name(header.frame_id)):
            return
        unconfirmed = is_unattested(query.source) and self._confirmable(header)
        self._go_on(query, header, T_map_camera, PriorSource.UNCONFIRMED if unconfirmed else PriorSource.LAST_ANSWER)

    def lose(self, reason: str, *, with_priors: bool) -> None:
        """Be lost, for this reason: forget the last answer, and what came from outside too where that is said."""
        if with_priors:
            self._inputs.forget_prior()
        else:
            self._inputs.forget_answer()
        self.state.reset(reason)

    def pass_time(self, images_wanted: bool) -> None:
        """Note that time has passed, perhaps without images, though they may be wanted."""
        self.state.pass_time(self._inputs.carried_sigma(), images_wanted)

    def _note_search(self, header: Header, estimate: Estimate) -> None:
        """Note how many views of the index were looked at in vain; once all were, they are looked at anew."""
        if not self._is_where_it_looked(header):
            self._looked_at, self._looked_from = 0, nanoseconds(header.stamp)
        looked_at = self._looked_at + estimate.evidence.searched
        found = estimate.T_map_camera is not None
        self._looked_at = 0 if found or looked_at >= estimate.evidence.index_views else looked_at

    def _is_where_it_looked(self, header: Header) -> bool:
        """Return whether the camera is known to be where views of the index were looked at in vain, if any were."""
        if not self._looked_at:
            return False
        travelled = self._inputs.travelled(self._looked_from, nanoseconds(header.stamp))
        return travelled is not None and travelled.distance <= _SAME_VIEW[0] and travelled.turn <= _SAME_VIEW[1]

    def _confirmable(self, header: Header) -> bool:
        stamp = nanoseconds(header.stamp)
        return self._track and self.images_come and stamp > 0 and self._inputs.has_odometry(stamp)

    def _go_on(self, query: LocalizerInput, header: Header, T_map_camera: np.ndarray, source: PriorSource) -> None:
        if self._track:
            frame = self._inputs.policy.map_frame
            answer = Prior(source, nanoseconds(header.stamp), frame, "", T_map_camera, None)
            self._inputs.take_answer(answer, query)
