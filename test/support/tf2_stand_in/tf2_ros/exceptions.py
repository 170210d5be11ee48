"""The exceptions of tf2_py."""

from __future__ import annotations


class TransformException(Exception):  # noqa: N818
    """A transform that cannot be given."""


class LookupException(TransformException):
    """An unknown frame."""


class ConnectivityException(TransformException):
    """Two frames that no chain of transforms connects."""


class ExtrapolationException(TransformException):
    """A time before the oldest sample or after the newest."""


class InvalidArgumentException(TransformException):
    """A name that no frame can have."""
