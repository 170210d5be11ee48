"""Which images are localized without being asked for."""

from __future__ import annotations

from collections import deque
from statistics import median_low

from gsfeatloc_ros.ros_io.settings import ON_PRIOR, ON_REQUEST, NodeSettings

# Steps between images, of which the median is taken for the camera's period.
_STEPS = 9
# Share of an image's distance from its turn by which later turns are moved: the turns settle in the middle of the
# jitter, and on every third image of a camera of 29.97 Hz. The rate may be exceeded by half of it.
_PULL = 0.04


class Schedule:
    """Says of each image, as it comes, whether it is due.

    Turns come at the largest rate, and the image nearest to a turn takes it: from one image that is due to the next
    there are as many images as the rates of camera and turns say, rounded up or down.

    Args:
        settings: mode and largest rate.

    Attributes:
        settings: may be replaced later.
    """

    def __init__(self, settings: NodeSettings) -> None:
        self.settings = settings
        self._prior_pending = False
        self._steps: deque[int] = deque(maxlen=_STEPS)
        # Stamp of the newest image, and of the next turn, in nanoseconds.
        self._newest: int | None = None
        self._turn = 0.0

    def take_prior(self, usable: bool) -> None:
        """Note that a prior came, and whether it can be used: an image may be due for it."""
        self._prior_pending = usable

    def is_due(self, stamp: int) -> bool:
        """Return whether an image is due, and note that it is.

        Args:
            stamp: of the image in nanoseconds, or the time at which it came where it has none.
        """
        if self._newest is None or stamp < self._newest:
            # The first image, or that of a bag that starts anew.
            self._turn = stamp
        else:
            self._steps.append(stamp - self._newest)
        self._newest = stamp
        mode = self.settings.mode
        if mode == ON_REQUEST or (mode == ON_PRIOR and not self._prior_pending) or not self._is_turn(stamp):
            return False
        self._prior_pending = False
        return True

    def _is_turn(self, stamp: int) -> bool:
        """Return whether an image takes the next turn; then there is another one."""
        if not self.settings.max_rate:
            return True
        period = 1e9 / self.settings.max_rate
        # The image after this one would be farther from the turn. Of a slow camera each takes one.
        half_step = 0.5 * min(median_low(self._steps), period) if self._steps else 0.0
        if stamp < self._turn - half_step:
            return False
        # Turns that nothing came for are not made up for.
        late = min(stamp - self._turn, half_step)
        self._turn = stamp + period - (1.0 - _PULL) * late
        return True
