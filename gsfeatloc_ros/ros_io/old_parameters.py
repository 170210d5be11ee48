"""Parameters of the last release, which are accepted for one more with a notice."""

from __future__ import annotations

RENAMED = {"renderer.threads": "cpu.threads"}
"""Names that still work, and what they are called now."""
RETIRED = {
    "localizer.min_inlier_ratio": "localizer.max_risk",
    "localizer.min_correlation": "localizer.max_risk",
    "localizer.min_agreement": "localizer.max_risk",
}
"""Names that have no effect, and what to set instead."""


def notice(name: str) -> str:
    """Return what to say of one of these names; empty for all others."""
    if name in RENAMED:
        return f"parameter {name} is called {RENAMED[name]} now: rename it"
    if name in RETIRED:
        return f"parameter {name} has no effect any more: set {RETIRED[name]} instead, and remove it"
    return ""
