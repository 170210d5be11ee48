"""What came out of a replay, for the terminal."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from statistics import median

from gsfeatloc_ros.replay.bag import Bag
from gsfeatloc_ros.replay.output import errors
from gsfeatloc_ros.replay.run import Replay, ReplayedImage
from gsfeatloc_ros.replay.truth import Trajectory
from gsfeatloc_ros.ros_io.outcome import OutcomeStatus

# Reasons of a kind, of which there may be as many as images.
_MAX_REASONS = 5
# A number in a reason, with its sign and exponent.
_NUMBER = re.compile(r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:e[-+]?\d+)?|\bnan\b|\binf\b")


def summary(bag: Bag, replay: Replay, images: Sequence[ReplayedImage], truth: Trajectory | None, seconds: float) -> str:
    """Return what came of a bag's images in so many seconds, line by line."""
    outcomes = [image.outcome for image in images]
    counts = Counter(outcome.status for outcome in outcomes)
    localized = counts.pop(OutcomeStatus.LOCALIZED, 0)
    lines = [f"localized {localized or 'NONE'} of {len(images)} images"]
    if len(images) + replay.not_due < bag.images:
        lines[0] += f"; the bag has {bag.images}"
    elif bag.seconds:
        lines[0] += f"; {bag.seconds:.1f} s of recording in {seconds:.1f} s"
    times = [outcome.estimate.milliseconds["total"] for outcome in outcomes if outcome.estimate is not None]
    if times:
        lines.append(f"  median {median(times):.0f} ms an image")
    if replay.not_due:
        lines.append(f"  {replay.not_due} more images were not due (mode, max_rate)")
    if replay.unstamped:
        lines.append(f"  {replay.unstamped} images have no stamp: their answers have the time of the recording")
    lines += [f"  {note}" for note in replay.notes]
    states = Counter(image.state.value for image in images)
    lines.append(f"  state after an image: {', '.join(f'{count} {state}' for state, count in states.most_common())}")
    for status in sorted(counts, key=lambda status: status.value):
        lines.append(f"  {counts[status]} {status.value}:")
        lines += counted_reasons([outcome.reason for outcome in outcomes if outcome.status is status])
    for role in sorted({role for role, _ in replay.unusable}, key=lambda role: role.value):
        lines.append(f"  {role.value} messages that cannot be used:")
        lines += counted_reasons(
            [why for (of, why), count in replay.unusable.items() if of is role for _ in range(count)]
        )
    if truth is not None:
        lines.append(_against_truth(images, truth, localized))
    return "\n".join(lines)


def counted_reasons(reasons: Sequence[str]) -> list[str]:
    """Return a line for each reason, the most frequent first; those that differ only in numbers count as one."""
    alike: dict[str, list[str]] = {}
    for reason in reasons:
        alike.setdefault(_NUMBER.sub("#", reason), []).append(reason)
    groups = sorted(alike.values(), key=len, reverse=True)
    lines = []
    for group in groups[:_MAX_REASONS]:
        such_as = "such as: " if len(set(group)) > 1 else ""
        lines.append(f"    {len(group)} x {such_as}{group[0]}")
    return lines + (["    ..."] if len(groups) > _MAX_REASONS else [])


def _against_truth(images: Sequence[ReplayedImage], truth: Trajectory, localized: int) -> str:
    known = [errors(image, truth) for image in images if image.pose is not None]
    pairs = [(each["rotation_error_deg"], each["translation_error"]) for each in known if each]
    line = f"  truth known for {len(pairs)} of the {localized} answers"
    if not pairs:
        return line
    rotation, translation = zip(*pairs, strict=True)
    return (
        f"{line}: median error {median(rotation):.3f} degrees, {median(translation):.4f} map units; largest "
        f"{max(rotation):.3f} degrees, {max(translation):.4f}"
    )
