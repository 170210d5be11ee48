"""Which images are localized without being asked for."""

from __future__ import annotations

from gsfeatloc_ros.ros_io.settings import ON_PRIOR, ON_REQUEST, NodeSettings


class Schedule:
    """Says of each image, as it comes, whether it is due.

    Args:
        settings: mode and largest rate.

    Attributes:
        settings: may be replaced later.
    """

    def __init__(self, settings: NodeSettings) -> None:
        self.settings = settings
        self._prior_pending = False
        # Stamp of the last image that was due, in nanoseconds.
        self._last = 0

    def take_prior(self, usable: bool) -> None:
        """Note that a prior came, and whether it can be used: an image may be due for it."""
        self._prior_pending = usable

    def is_due(self, stamp: int) -> bool:
        """Return whether an image is due, and note that it is.

        Args:
            stamp: of the image in nanoseconds, or the time at which it came where it has none.
        """
        mode, max_rate = self.settings.mode, self.settings.max_rate
        if mode == ON_REQUEST or (mode == ON_PRIOR and not self._prior_pending):
            return False
        # Stamps that go back are those of a bag that starts anew.
        if max_rate and 0 <= stamp - self._last < 1e9 / max_rate:
            return False
        self._prior_pending, self._last = False, stamp
        return True
