"""An inspection in words."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from gsfeatloc_ros.inspect.inspection import Inspection
from gsfeatloc_ros.inspect.photos import PhotoFit
from gsfeatloc_ros.inspect.statistics import Histogram

_BARS = " ▁▂▃▄▅▆▇█"


def rows(inspection: Inspection) -> Iterator[tuple[str, str]]:
    """Yield what was found, as names and words."""
    source, gaussians, quality = inspection.source, inspection.statistics, inspection.quality
    yield "file", f"{source.path}, {source.megabytes:.1f} MB"
    yield "format", source.format
    yield "producer", source.producer
    yield "Gaussians", f"{gaussians.count:,}, {gaussians.solid:.0%} of them cover more than a half"
    yield "SH degree", str(gaussians.sh_degree)
    yield "antialiased", "yes" if gaussians.antialiased else "no"
    yield "solid, from", f"{_point(gaussians.solid_low)} to {_point(gaussians.solid_high)} (percentiles 1 and 99)"
    yield "all, from", f"{_point(gaussians.low)} to {_point(gaussians.high)}"
    yield "opacity", f"0 {bars(gaussians.opacity)} 1"
    low, high = (10.0 ** gaussians.scale.edges[end] for end in (0, -1))
    yield "scale", f"{low:.2g} {bars(gaussians.scale)} {high:.2g} units (the largest axis, logarithmic)"
    yield "flatness", f"{gaussians.flatness:.2g}, the smallest axis over the largest (median)"
    yield (
        "views",
        f"{quality.views}: {quality.corners:.0f} features, {quality.lifted:.0%} with depth to trust (medians)",
    )
    yield "floaters", _floaters(inspection)
    yield "up", _up(inspection)
    yield "floor, ceiling", _floor(inspection)
    yield "unit", _unit(inspection)
    for name, values in inspection.parameters.items():
        yield "to set upright", f"{name}: {values}"
    if inspection.fit is not None:
        yield from _fit_rows(inspection.fit)


def as_text(inspection: Inspection) -> str:
    """Return all that was found for a terminal."""
    lines = [f"{name:15} {words}" for name, words in rows(inspection)]
    lines += ["", *(f"note: {note}" for note in inspection.notes)]
    lines += [f"looks wrong: {problem}" for problem in inspection.problems] or ["nothing looks wrong"]
    return "\n".join(lines)


def bars(histogram: Histogram) -> str:
    """Return a histogram as a row of bars."""
    counts = np.array(histogram.counts, np.float64)
    heights = np.ceil(counts / max(counts.max(), 1) * (len(_BARS) - 1)).astype(int)
    return "".join(_BARS[height] for height in heights)


def _floaters(inspection: Inspection) -> str:
    floaters = inspection.floaters
    if not floaters.count:
        return "none seen"
    return f"{floaters.count:,} ({floaters.share:.2%}), most from {_point(floaters.low)} to {_point(floaters.high)}"


def _up(inspection: Inspection) -> str:
    upright = inspection.upright
    if upright is None:
        return "not to be told: no surfaces are seen"
    sure = "sure" if upright.sure else "a guess"
    tops = f"{(1 + upright.excess) / 2:.0%} of the level surfaces at middle height face it"
    return f"{_point(upright.up)}, {sure}: {upright.level:.0%} of the surfaces are level then, {tops}"


def _floor(inspection: Inspection) -> str:
    upright = inspection.upright
    if upright is None or not upright.sure or upright.floor is None:
        return "not to be told"
    ceiling = "no ceiling" if upright.ceiling is None else f"ceiling at {upright.ceiling:.3f}"
    return f"floor at {upright.floor:.3f} along up, {ceiling}"


def _unit(inspection: Inspection) -> str:
    unit = inspection.unit
    if unit is None:
        return "nothing tells it"
    metre = "may be the metre" if unit.may_be_metre else "not the metre"
    return f"{metre}: likely {unit.likely:.3g} m, {unit.low:.2g} to {unit.high:.2g}, as {unit.by}"


def _fit_rows(fit: PhotoFit) -> Iterator[tuple[str, str]]:
    worst = int(np.argmin(fit.psnr))
    yield (
        "photos",
        f"{len(fit.psnr)} of {fit.scene}: {np.mean(fit.psnr):.2f} dB (mean PSNR, exposure fitted), worst "
        f"{fit.psnr[worst]:.2f} dB, {fit.names[worst]}",
    )
    for each in fit.comparisons:
        one, other = (f"{value} {psnr:.2f} dB" for value, psnr in zip(each.values, each.psnr, strict=True))
        yield each.parameter, f"{one}, {other}, gain {each.gain:+.2f} +- {each.sigma:.2f}: {each.advice}"


def _point(values: Sequence[float]) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in values) + ")"
