"""The typed messages and services of gsfeatloc_interfaces, which is optional: interfaces/ is built apart."""

from __future__ import annotations

try:
    from gsfeatloc_interfaces.msg import ProtectionLevel as ProtectionLevelMessage
    from gsfeatloc_interfaces.srv import LocalizeImage
except ImportError:  # of an older build, too: none of it is used then
    LocalizeImage = ProtectionLevelMessage = None

__all__ = ["LocalizeImage", "ProtectionLevelMessage"]
