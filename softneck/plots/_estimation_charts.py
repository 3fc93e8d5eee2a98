"""NIS and NEES of a Kalman filter with their chi-square bounds, as plain data."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np

from softneck.core import Vector

from ._chart import Chart, Curve, Level, Panel
from ._figures import chart_figure
from ._style import BLUE, GREY, ORANGE

if TYPE_CHECKING:
    import matplotlib.figure


class NormalisedSquares(Protocol):
    """What `softneck.estimation._consistency.Squares` is; this layer knows no filters."""

    @property
    def time(self) -> Vector: ...
    @property
    def values(self) -> Vector: ...
    @property
    def band(self) -> tuple[float, float]: ...
    @property
    def inside(self) -> float: ...
    @property
    def mean(self) -> float: ...
    @property
    def average(self) -> Vector: ...
    @property
    def average_band(self) -> tuple[float, float]: ...
    @property
    def window(self) -> int: ...


def consistency_chart(nis: NormalisedSquares, nees: NormalisedSquares | None = None, *, title: str = "") -> Chart:
    """Return NIS, and NEES where the truth is known, sample by sample and averaged, with both ends of their bands.

    Too high: the filter is surer of itself than it should be. Too low: it could trust its model more.
    """
    named = [("NIS", nis)] + ([("NEES", nees)] if nees is not None else [])
    panels = [
        Panel(
            curves=(
                # The logarithmic axis has no zero; no chi-square value of interest is below a thousandth.
                Curve(s.time, np.maximum(s.values, 1e-3), label=f"{name} of a sample", colour=GREY, style="points"),
                Curve(s.time, s.average, label=f"mean of {s.window}", colour=BLUE, width=1.5),
            ),
            y_label=f"{name} [-]",
            levels=(
                Level(s.band[0], label="band of a sample", colour=GREY),
                Level(s.band[1], colour=GREY),
                Level(s.average_band[0], label="band of the mean", colour=ORANGE),
                Level(s.average_band[1], colour=ORANGE),
            ),
            title=f"{100.0 * s.inside:.1f} % of samples inside, mean {s.mean:.2f}",
            log_y=True,
        )
        for name, s in named
    ]
    return Chart(title=title or "Consistency of the filter", panels=panels)


def consistency_figure(
    nis: NormalisedSquares, nees: NormalisedSquares | None = None, *, title: str = ""
) -> matplotlib.figure.Figure:
    """Return `consistency_chart` as a matplotlib figure."""
    return chart_figure(consistency_chart(nis, nees, title=title))
