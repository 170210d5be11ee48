"""What the node says about every attempt on /diagnostics."""

from __future__ import annotations

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from gsfeatloc_ros.estimate import Estimate

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


def stamp_text(stamp: Time) -> str:
    """A stamp as seconds with nine decimals, exact."""
    return f"{stamp.sec}.{stamp.nanosec:09d}"


def evidence(estimate: Estimate) -> dict[str, str]:
    """What stands behind an estimate, as words for a diagnostic."""
    return {
        "matches": str(estimate.matches),
        "inliers": str(estimate.inliers),
        "inlier_ratio": f"{estimate.inlier_ratio:.3f}",
        "coverage": f"{estimate.coverage:.3f}",
        "agreement": f"{estimate.agreement:.3f}",
        "reprojection_error_px": f"{estimate.reprojection_error:.3f}",
        "passes": str(estimate.passes),
        "views": str(estimate.views),
        **{f"ms_{stage}": f"{duration:.1f}" for stage, duration in estimate.milliseconds.items()},
    }


def diagnostic_message(
    now: Time, name: str, level: bytes, status: str, reason: str, values: dict[str, str]
) -> DiagnosticArray:
    """One DiagnosticStatus of `name` with `status` and `reason` among its values."""
    values = {"status": status, "reason": reason, **values}
    message = DiagnosticArray()
    message.header.stamp = now
    message.status = [
        DiagnosticStatus(
            level=level,
            name=name,
            message=reason,
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )
    ]
    return message
