"""What there is to show, which comes from several threads."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from gsfeatloc_ros.view.attempts import Attempt, Prior
from gsfeatloc_ros.view.recorded import SmallPhoto

# Attempts that are kept: an hour, of one each four seconds.
_MAX_ATTEMPTS = 1000


class Store:
    """Attempts in the order in which they came, with their photos and priors, by their stamps in nanoseconds."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._attempts: dict[int, Attempt] = {}
        self._pictures: dict[int, SmallPhoto | np.ndarray] = {}
        self._priors: dict[int, Prior] = {}
        self._newest_prior: Prior | None = None
        self._changes = 0

    def add(self, attempt: Attempt) -> None:
        """Take an attempt, or what more is known of one: parts that are None stay as they were."""
        with self._lock:
            known = self._attempts.get(attempt.stamp)
            if known is None and self._newest_prior is not None:
                self._priors.setdefault(attempt.stamp, self._newest_prior)
            self._attempts[attempt.stamp] = attempt if known is None else _merged(known, attempt)
            while len(self._attempts) > _MAX_ATTEMPTS:
                oldest = next(iter(self._attempts))
                for group in (self._attempts, self._pictures, self._priors):
                    group.pop(oldest, None)
            self._changes += 1

    def add_prior(self, prior: Prior) -> None:
        """Take a prior: it is that of the attempts which come after it."""
        with self._lock:
            self._newest_prior = prior
            self._changes += 1

    def add_recording(self, photos: Mapping[int, SmallPhoto], priors: Mapping[int, np.ndarray]) -> None:
        """Take photos, and priors (4, 4) of the camera, by stamp."""
        with self._lock:
            self._pictures.update(photos)
            self._priors.update({stamp: Prior(pose) for stamp, pose in priors.items()})
            self._changes += 1

    def add_picture(self, stamp: int, jpeg: np.ndarray) -> None:
        """Take the encoded picture of an attempt, as the node draws it."""
        with self._lock:
            self._pictures[stamp] = jpeg
            while len(self._pictures) > _MAX_ATTEMPTS:
                del self._pictures[next(iter(self._pictures))]
            self._changes += 1

    @property
    def changes(self) -> int:
        """A number that is another once something came."""
        return self._changes

    @property
    def newest_prior(self) -> Prior | None:
        """What came last of `add_prior`."""
        return self._newest_prior

    def attempts(self) -> list[Attempt]:
        """Return all attempts."""
        with self._lock:
            return list(self._attempts.values())

    def picture(self, stamp: int) -> SmallPhoto | np.ndarray | None:
        """Return the photo of an attempt, or its picture as the node draws it, encoded."""
        with self._lock:
            return self._pictures.get(stamp)

    def prior(self, stamp: int) -> Prior | None:
        """Return the prior that an attempt began with."""
        with self._lock:
            return self._priors.get(stamp)


def _merged(known: Attempt, more: Attempt) -> Attempt:
    """Return what both say of an attempt; where both say something, the second."""
    parts = {
        name: value
        for name, value in vars(more).items()
        if not (value is None or (isinstance(value, str) and not value))
    }
    return replace(known, **parts)
