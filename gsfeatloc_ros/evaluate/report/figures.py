"""Figures of the report, as SVG."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np

from gsfeatloc_ros.evaluate.extras import import_extra
from gsfeatloc_ros.evaluate.metrics import (
    MAX_ROTATION_ERROR_DEG,
    MAX_TRANSLATION_ERROR,
    QueryResult,
    by_step,
    chi_square_cdf,
)

# A figure's content: names and results of what is compared.
Named = Sequence[tuple[str, Sequence[QueryResult]]]

_STYLE = {
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#8a94a0",
    "axes.labelcolor": "#3a4450",
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e4e8ec",
    "xtick.color": "#5a6470",
    "ytick.color": "#5a6470",
    "legend.frameon": False,
    "svg.fonttype": "none",
}
# Okabe and Ito's, which the colour-blind can tell apart.
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
_LIMIT_COLOUR = "#b3261e"
_STAGE_COLOURS = ("#0072b2", "#56b4e9", "#009e73", "#e69f00", "#cc79a7", "#d55e00", "#999999", "#332288")


def success_curves(named: Named, rotation: bool) -> str:
    """Plot success against the error of the prior, of a sweep of the rotation or else of the translation."""
    with _Canvas(1, height=3.2) as canvas:
        (axes,) = canvas.axes
        for (name, results), colour in zip(named, _cycle(_COLOURS), strict=False):
            steps = by_step(results)
            key = "prior_rotation_error_deg" if rotation else "prior_translation_error"
            errors = [step[key] for step in steps]
            success = [100 * step["success_rate"] for step in steps]
            wrong = [100 * step["wrong_answers"] / step["queries"] for step in steps]
            axes.plot(errors, success, color=colour, marker="o", markersize=4, label=name)
            axes.plot(errors, wrong, color=colour, linestyle=":", label=f"{name}, wrong answers")
        axes.set_ylim(-3, 103)
        axes.set_ylabel("photos, %")
        axes.set_xlabel("prior turned by, degrees" if rotation else "prior moved by, radii")
        axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    return canvas.svg


def error_histograms(named: Named) -> str:
    """Plot how large the errors are."""
    with _Canvas(2, height=3.1) as canvas:
        kinds = (
            ("rotation_error_deg", "Rotation error", "degrees", MAX_ROTATION_ERROR_DEG, 1e-4),
            ("translation_error", "Translation error", "radii of the trajectory", MAX_TRANSLATION_ERROR, 1e-6),
        )
        for axes, (key, title, unit, limit, smallest) in zip(canvas.axes, kinds, strict=True):
            every = [np.maximum([getattr(result, key) for result in results], smallest) for _, results in named]
            low = np.log10(min(errors.min() for errors in every)) - 0.1
            high = np.log10(max(2 * limit, *(errors.max() for errors in every))) + 0.1
            bins = np.logspace(low, high, round(12 * (high - low)))
            for (name, _), errors, colour in zip(named, every, _cycle(_COLOURS), strict=False):
                weights = np.full(len(errors), 100 / len(errors))
                axes.hist(errors, bins, weights=weights, histtype="stepfilled", color=colour, alpha=0.15)
                axes.hist(errors, bins, weights=weights, histtype="step", color=colour, label=name)
                axes.axvline(np.median(errors), color=colour, linestyle=":", linewidth=1)
            axes.axvline(limit, color=_LIMIT_COLOUR, linewidth=1)
            corner = axes.get_xaxis_transform()
            axes.text(1.05 * limit, 0.99, f"{limit:g}", transform=corner, va="top", color=_LIMIT_COLOUR, fontsize=8)
            axes.set_xscale("log")
            axes.set_title(title)
            axes.set_xlabel(f"{unit} (dotted: median)")
        canvas.axes[0].set_ylabel("photos, %")
        canvas.legend()
    return canvas.svg


def calibration(named: Named) -> str:
    """Plot how many truths the ellipsoids hold against how many they should, and the spread of the NEES."""
    with _Canvas(2, height=3.3) as canvas:
        coverage, spread = canvas.axes
        nominal = np.linspace(0, 1, 101)
        smallest = min(len(results) for _, results in named)
        noise = 1.645 * np.sqrt(nominal * (1 - nominal) / smallest)
        coverage.fill_between(100 * nominal, 100 * (nominal - noise), 100 * (nominal + noise), color="#eceff2")
        coverage.plot([0, 100], [0, 100], color="#8a94a0", linestyle="--", linewidth=1)
        edges = np.linspace(0, 4, 33)
        for (name, results), colour in zip(named, _cycle(_COLOURS), strict=False):
            nees = np.array([result.nees for result in results])
            held = np.mean(chi_square_cdf(6 * nees)[:, None] <= nominal, axis=0)
            coverage.plot(100 * nominal, 100 * held, color=colour, label=name)
            weights = np.full(len(nees), 1 / (len(nees) * (edges[1] - edges[0])))
            clipped = np.minimum(nees, edges[-1] - 1e-9)
            spread.hist(clipped, edges, weights=weights, histtype="stepfilled", color=colour, alpha=0.15)
            spread.hist(clipped, edges, weights=weights, histtype="step", color=colour)
        # The density of chi-square with 6 degrees of freedom, x^2 exp(-x / 2) / 16, at x = 6 y, over y.
        y = np.linspace(0, 4, 200)
        spread.plot(y, 6 * (6 * y) ** 2 * np.exp(-3 * y) / 16, color="#8a94a0", linestyle="--", label="if calibrated")
        coverage.set_title("Truths inside the ellipsoid")
        coverage.set_xlabel("that should hold, %")
        coverage.set_ylabel("that holds, %")
        coverage.set_xlim(0, 100)
        coverage.set_ylim(0, 100)
        spread.set_title("NEES per degree of freedom")
        spread.set_xlabel("1 on average if calibrated; the last bar has all above")
        spread.set_ylabel("density")
        spread.legend(loc="upper right")
        canvas.legend()
    return canvas.svg


def stage_times(named: Named) -> str:
    """Plot where the time goes, in milliseconds a photo on average."""
    # At least as high as the legend is.
    with _Canvas(1, height=max(0.9 + 0.42 * len(named), 2.4)) as canvas:
        (axes,) = canvas.axes
        stages = list(dict.fromkeys(stage for _, results in named for r in results for stage in r.stage_milliseconds))
        stages = [stage for stage in stages if stage != "total"]
        names = [name for name, _ in named]
        left = np.zeros(len(named))
        for stage, colour in zip(stages, _cycle(_STAGE_COLOURS), strict=False):
            widths = np.array([np.mean([r.stage_milliseconds.get(stage, 0.0) for r in rs]) for _, rs in named])
            axes.barh(names, widths, left=left, height=0.6, color=colour, label=stage)
            left += widths
        total = np.array([np.mean([r.milliseconds for r in results]) for _, results in named])
        axes.barh(names, np.maximum(total - left, 0), left=left, height=0.6, color="#c9d0d6", label="other")
        for row, value in enumerate(total):
            axes.annotate(f" {value:.0f}", (value, row), va="center", color="#3a4450")
        axes.set_xlabel("milliseconds a photo, mean")
        axes.invert_yaxis()
        axes.grid(axis="y", visible=False)
        axes.margins(x=0.08)
        axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    return canvas.svg


class _Canvas:
    """A figure with axes in a row, in the style of the page; `svg` is there when the block is left."""

    def __init__(self, columns: int, height: float) -> None:
        matplotlib = import_extra("matplotlib")
        self._style = matplotlib.rc_context(_STYLE)
        self._columns, self._height = columns, height

    def __enter__(self) -> _Canvas:
        self._style.__enter__()
        self._figure = import_extra("matplotlib.figure").Figure(figsize=(10, self._height), layout="constrained")
        self.axes = list(self._figure.subplots(1, self._columns, squeeze=False)[0])
        return self

    def legend(self) -> None:
        """Draw one legend for all axes, above them."""
        handles, labels = self.axes[0].get_legend_handles_labels()
        self._figure.legend(handles, labels, loc="outside upper left", ncols=4)

    def __exit__(self, kind: object, error: object, traceback: object) -> None:
        if kind is None:
            file = io.StringIO()
            self._figure.savefig(file, format="svg", metadata={"Date": None})
            text = file.getvalue()
            self.svg = text[text.index("<svg") :]
        self._style.__exit__(kind, error, traceback)


def _cycle(colours: Sequence[str]) -> list[str]:
    return list(colours) * 8
