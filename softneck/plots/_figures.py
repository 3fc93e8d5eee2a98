"""Every chart as a function that returns a matplotlib figure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from softneck.core import Matrix, Vector

from ._charts import delay_chart, loop_chart, recording_chart, validation_chart
from ._judgement_charts import cost_chart, histogram_chart, residual_chart
from ._matplotlib import chart_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def recording_figure(
    time: Vector, set_points: Matrix, outputs: Matrix, title: str, *, run: np.ndarray | None = None
) -> Figure:
    """Draw `recording_chart`: motor set-points (time, 3) [rad], pitch and roll (time, 2) [rad] in degrees."""
    return chart_figure(recording_chart(time, set_points, outputs, title, run=run))


def validation_figure(
    time: Vector,
    measured: Matrix,
    predictions: Mapping[str, Matrix],
    title: str,
    *,
    bounds: tuple[Matrix, Matrix] | None = None,
    run: np.ndarray | None = None,
) -> Figure:
    """Draw `validation_chart`: measured and predicted pitch and roll (time, 2) [rad], each with its error below."""
    return chart_figure(validation_chart(time, measured, predictions, title, bounds=bounds, run=run))


def loop_figure(time: Vector, signals: Mapping[str, Vector], title: str) -> Figure:
    """Draw `loop_chart`: reference, true, measured and estimated angles, motors, tensions where there are any."""
    return chart_figure(loop_chart(time, signals, title))


def delay_figure(curves: Mapping[str, list[list[float]]], title: str) -> Figure:
    """Draw `delay_chart`: the cost curve of the dead time."""
    return chart_figure(delay_chart(curves, title))


def residual_figure(
    autocorrelation: tuple[np.ndarray, Matrix, Vector], cross_correlation: tuple[np.ndarray, Matrix, Matrix], title: str
) -> Figure:
    """Draw `residual_chart`: correlation of one-step errors with themselves and with the set-points, with bounds."""
    return chart_figure(residual_chart(autocorrelation, cross_correlation, title))


def histogram_figure(errors: Matrix, title: str) -> Figure:
    """Draw `histogram_chart`: how errors (time, 2) [rad] are spread, in degrees, beside a normal curve."""
    return chart_figure(histogram_chart(errors, title))


def cost_figure(
    values: Vector, costs: Mapping[str, Vector], labels: tuple[str, str], title: str, *, chosen: float | None = None
) -> Figure:
    """Draw `cost_chart`: the cost curve of a search."""
    return chart_figure(cost_chart(values, costs, labels, title, chosen=chosen))
