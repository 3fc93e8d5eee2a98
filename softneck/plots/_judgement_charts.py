"""The charts of what a validation finds: residual tests, histograms of errors, and the cost curves of a search."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from softneck.core import DataError, Matrix, Vector

from ._chart import Chart, Curve, Level, Panel
from ._style import AXES, BLUE, GREY, RED, looks

_BOUND = "99 % bounds"
# Bins of a histogram at most; more are thinner than what a screen shows.
_BINS = 120


def residual_chart(
    autocorrelation: tuple[np.ndarray, Matrix, Vector],
    cross_correlation: tuple[np.ndarray, Matrix, Matrix],
    title: str,
    *,
    caption: str = "",
) -> Chart:
    """Describe residual tests as MATLAB's `resid`: one column for pitch, one for roll.

    Args:
        autocorrelation: of the one-step errors: lags (n,) [samples], values (2, n) and their bounds (2,); lag 0,
            which is 1, is not drawn.
        cross_correlation: with the motors' set-points: lags (m,) [samples], values (2, 3, m), bounds (2, 3).
        title: of the chart.
        caption: for under the chart.

    Raises:
        DataError: shapes do not fit.
    """
    lags, values, bounds = autocorrelation
    cross_lags, cross, cross_bounds = cross_correlation
    if values.shape != (2, len(lags)) or cross.shape != (2, 3, len(cross_lags)):
        raise DataError(
            f"residual tests need correlations (2, lags) and (2, 3, lags); got {values.shape} at {len(lags)} lags "
            f"and {cross.shape} at {len(cross_lags)}."
        )
    kept = np.asarray(lags) != 0
    panels = [
        _stems(np.asarray(lags)[kept], values[i, kept], float(bounds[i]), f"{AXES[i]}: error with itself later")
        for i in range(2)
    ]
    for j in range(3):
        panels += [
            _stems(
                cross_lags, cross[i, j], float(cross_bounds[i, j]), f"{AXES[i]}: error with set-point {j + 1} earlier"
            )
            for i in range(2)
        ]
    return Chart(title, panels, "lag [samples]", columns=2, linked=False, caption=caption, row_height=1.9)


def _stems(lags: np.ndarray, values: Vector, bound: float, title: str) -> Panel:
    x = np.asarray(lags, dtype=np.float64)
    out = np.abs(values) > bound
    curves = [
        Curve(x, np.where(out, np.nan, values), "within", BLUE, "stems"),
        Curve(x, np.where(out, values, np.nan), "outside", RED, "stems"),
    ]
    levels = [Level(0.0, dashed=False)]
    if np.isfinite(bound):  # too few rows have none
        levels += [Level(bound, _BOUND), Level(-bound)]
    edge = 1.15 * max(float(np.nan_to_num(bound)), float(np.nan_to_num(np.abs(values)).max(initial=0.0)), 1e-3)
    return Panel(curves, "correlation", levels=levels, title=title, legend=False, y_range=(-edge, edge))


def histogram_chart(errors: Matrix, title: str, *, caption: str = "") -> Chart:
    """Describe how errors are spread, beside the normal curve of the same mean and standard deviation.

    Args:
        errors: (time, 2) of pitch and roll [rad], drawn in degrees; rows that are not finite are left out.
        title: of the chart.
        caption: for under the chart.

    Raises:
        DataError: no error is finite.
    """
    panels = [_histogram(AXES[i], np.degrees(errors[:, i])) for i in range(2)]
    return Chart(title, panels, "error [deg]", columns=2, linked=False, caption=caption)


def _histogram(axis: str, errors: Vector) -> Panel:
    e = errors[np.isfinite(errors)]
    if e.size == 0:
        raise DataError(f"there is no error of {axis} to draw a histogram of.")
    mean, spread = float(e.mean()), float(e.std())
    low, high = float(e.min()), float(e.max())
    if high - low <= 1e-12 * max(1.0, abs(high)):  # all errors are one number
        low, high = low - 0.5, high + 0.5
    # Freedman and Diaconis' width 2 IQR n^(-1/3), within what can be read.
    quartiles = np.percentile(e, [25, 75])
    width = 2.0 * float(quartiles[1] - quartiles[0]) * e.size ** (-1 / 3)
    bins = int(np.clip((high - low) / width if width > 0 else _BINS, 10, _BINS))
    density, edges = np.histogram(e, bins=bins, range=(low, high), density=True)
    curves = [Curve(0.5 * (edges[:-1] + edges[1:]), density, "errors", BLUE, "bars")]
    if spread > 0:
        x = np.linspace(low, high, 301)
        normal = np.exp(-0.5 * ((x - mean) / spread) ** 2) / (spread * np.sqrt(2 * np.pi))
        curves.append(Curve(x, normal, "normal", RED, width=1.2))
    title = f"{axis}: mean {mean:.3g} deg, standard deviation {spread:.3g} deg"
    return Panel(curves, "density [1/deg]", title=title)


def cost_chart(
    values: Vector,
    costs: Mapping[str, Vector],
    labels: tuple[str, str],
    title: str,
    *,
    chosen: float | None = None,
    caption: str = "",
) -> Chart:
    """Describe the cost curve of a search: a score against one parameter, one line for each value of another.

    Args:
        values: (n,) of the parameter.
        costs: name of a line -> (n,) scores; NaN where none could be found.
        labels: of the x and of the y axis, with their units.
        title: of the chart.
        chosen: the parameter that was taken.
        caption: for under the chart.
    """
    curves = [
        Curve(values, np.asarray(cost), name, colour, "marked")
        for (name, cost), (colour, _) in zip(costs.items(), looks(), strict=False)
    ]
    levels = () if chosen is None else (Level(chosen, "chosen", GREY, vertical=True),)
    return Chart(title, [Panel(curves, labels[1], levels=levels)], labels[0], caption=caption, row_height=3.0)
