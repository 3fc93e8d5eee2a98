"""The charts of what a validation finds: residual tests, histograms of errors, reliability."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from softneck.core import DataError, Matrix, Vector
from softneck.robot import Robot
from softneck.signals.recording._channels import NECK

from ._chart import Chart, Curve, Level, Panel
from ._style import BLUE, GREY, RED, shown

_BOUND = "99 % bounds"
# Bins of a histogram at most; more are thinner than what a screen shows.
_BINS = 120


def residual_chart(
    autocorrelation: tuple[np.ndarray, Matrix, Vector],
    cross_correlation: tuple[np.ndarray, Matrix, Matrix],
    title: str,
    *,
    caption: str = "",
    robot: Robot = NECK,
) -> Chart:
    """Describe residual tests as MATLAB's `resid`: one column for each output, of a neck pitch and roll.

    Args:
        autocorrelation: of the one-step errors: lags (n,) [samples], values (outputs, n) and their bounds (outputs,);
            lag 0, which is 1, is not drawn.
        cross_correlation: with the motors' set-points: lags (m,) [samples], values (outputs, motors, m), bounds
            (outputs, motors).
        title: of the chart.
        caption: for under the chart.
        robot: whose outputs and motors these are.

    Raises:
        DataError: shapes do not fit.
    """
    lags, values, bounds = autocorrelation
    cross_lags, cross, cross_bounds = cross_correlation
    axes, motors = robot.outputs.names, len(robot.motors.names)
    if values.shape != (len(axes), len(lags)) or cross.shape != (len(axes), motors, len(cross_lags)):
        raise DataError(
            f"residual tests need correlations ({len(axes)}, lags) and ({len(axes)}, {motors}, lags); got "
            f"{values.shape} at {len(lags)} lags and {cross.shape} at {len(cross_lags)}."
        )
    kept = np.asarray(lags) != 0
    panels = [
        _stems(np.asarray(lags)[kept], values[i, kept], float(bounds[i]), f"{axis}: error with itself later")
        for i, axis in enumerate(axes)
    ]
    for j in range(motors):
        panels += [
            _stems(cross_lags, cross[i, j], float(cross_bounds[i, j]), f"{axis}: error with set-point {j + 1} earlier")
            for i, axis in enumerate(axes)
        ]
    return Chart(title, panels, "lag [samples]", columns=len(axes), linked=False, caption=caption, row_height=1.9)


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


def histogram_chart(errors: Matrix, title: str, *, caption: str = "", robot: Robot = NECK) -> Chart:
    """Describe how errors are spread, beside the normal curve of the same mean and standard deviation.

    Args:
        errors: (time, outputs) in SI, of a neck of pitch and roll [rad]; rows that are not finite are left out.
        title: of the chart.
        caption: for under the chart.
        robot: whose outputs these are; errors are drawn in its display unit.

    Raises:
        DataError: no error is finite.
    """
    axes, unit = robot.outputs.names, robot.outputs.display_unit
    panels = [_histogram(axis, shown(errors[:, i], robot), unit) for i, axis in enumerate(axes)]
    return Chart(title, panels, f"error [{unit}]", columns=len(axes), linked=False, caption=caption)


def _histogram(axis: str, errors: Vector, unit: str) -> Panel:
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
    title = f"{axis}: mean {mean:.3g} {unit}, standard deviation {spread:.3g} {unit}"
    return Panel(curves, f"density [1/{unit}]", title=title)


def reliability_chart(rows: Sequence[Mapping[str, float]], title: str) -> Chart:
    """Describe how often what was predicted with a probability happened; on the diagonal it is as often as said.

    Args:
        rows: `predicted`, `held` and `rows` of each group of samples.
        title: of the chart.
    """
    predicted, held, count = (np.array([row[name] for row in rows]) for name in ("predicted", "held", "rows"))
    ends = np.array([0.0, 1.0])
    panels = [
        Panel(
            [
                Curve(ends, ends, "as often as said", GREY, "dashed"),
                Curve(predicted, held, "samples", BLUE, "marked", width=2.0),
            ],
            "share within the tolerance",
            y_range=(-0.05, 1.05),
        ),
        Panel([Curve(predicted, count, "", BLUE, "stems")], "samples", legend=False),
    ]
    return Chart(title, panels, "predicted probability")
