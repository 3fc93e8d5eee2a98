"""The charts of a study: what its runs trade, how metrics are spread, and what they depend on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from softneck.core import DataError, Vector

from ._chart import Chart, Curve, Panel
from ._figures import chart_figure
from ._style import BLUE, GREY, RED, looks

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_POINT = 1.6
_BINS = 40


def pareto_chart(
    groups: Mapping[str, tuple[Vector, Vector]],
    front: tuple[Vector, Vector],
    labels: tuple[str, str],
    title: str,
    *,
    caption: str = "",
) -> Chart:
    """Describe runs by two metrics, and the front that no run beats in both.

    Args:
        groups: name -> (x, y) of its runs; runs that are not finite are left out.
        front: (x, y) of the front, by rising x.
        labels: of the axes.
        title: of the chart.
        caption: for under the chart.

    Raises:
        DataError: no run has both metrics.
    """
    curves = []
    for (name, (x, y)), (colour, _) in zip(groups.items(), looks(), strict=False):
        known = np.isfinite(x) & np.isfinite(y)
        if known.any():
            curves.append(Curve(np.asarray(x)[known], np.asarray(y)[known], name, colour, "points", _POINT))
    if not curves:
        raise DataError(f"no run has both {labels[0]} and {labels[1]}.")
    curves.append(Curve(front[0], front[1], "Pareto front", RED, "marked", 1.4))
    return Chart(title, [Panel(curves, labels[1])], labels[0], caption=caption, row_height=4.0)


def distribution_chart(values: Mapping[str, Mapping[str, Vector]], title: str, *, caption: str = "") -> Chart:
    """Describe how metrics are spread over the runs: a panel for each metric, a line for each group.

    Args:
        values: metric -> name of a group -> (n,); values that are not finite are left out.
        title: of the chart.
        caption: for under the chart.

    Raises:
        DataError: no value is finite.
    """
    panels = []
    for metric, groups in values.items():
        known = {name: np.asarray(v, float)[np.isfinite(np.asarray(v, float))] for name, v in groups.items()}
        known = {name: v for name, v in known.items() if v.size}
        if known:
            panels.append(_shares(metric, known, legend=not panels))
    if not panels:
        raise DataError("no run has a metric to show.")
    return Chart(title, panels, linked=False, caption=caption, row_height=2.0)


def influence_chart(
    inputs: Mapping[str, Vector], metric: tuple[str, Vector], failed: np.ndarray, title: str, *, caption: str = ""
) -> Chart:
    """Describe what a metric depends on: a panel for each number that varied, a point for each run.

    Args:
        inputs: key -> (n,) what was put in.
        metric: its label and (n,) values.
        failed: (n,) whether a run broke a limit; such are drawn in another colour.
        title: of the chart.
        caption: for under the chart.
    """
    label, y = metric
    bad = np.asarray(failed, dtype=bool)
    panels = []
    for key, x in inputs.items():
        curves = []
        for mask, name, colour in ((~bad, "holds", BLUE), (bad, "breaks a limit", RED)):
            known = mask & np.isfinite(y) & np.isfinite(x)
            if known.any():
                curves.append(Curve(np.asarray(x, float)[known], y[known], name, colour, "points", _POINT))
        curves = curves or [Curve(np.zeros(0), np.zeros(0), "", GREY, "points")]
        panels.append(Panel(curves, label, x_label=key, legend=not panels))
    return Chart(title, panels, linked=False, caption=caption, row_height=2.0)


def pareto_figure(
    groups: Mapping[str, tuple[Vector, Vector]], front: tuple[Vector, Vector], labels: tuple[str, str], title: str
) -> Figure:
    """Draw `pareto_chart`: runs by two metrics and their Pareto front."""
    return chart_figure(pareto_chart(groups, front, labels, title))


def _shares(metric: str, groups: Mapping[str, Vector], *, legend: bool) -> Panel:
    """Return the share of each group's runs in each of the bins that all groups have in common."""
    every = np.concatenate(list(groups.values()))
    low, high = float(every.min()), float(every.max())
    if high - low <= 1e-12 * max(1.0, abs(high)):
        low, high = low - 0.5, high + 0.5
    edges = np.linspace(low, high, int(np.clip(np.sqrt(every.size), 8, _BINS)) + 1)
    middles = 0.5 * (edges[:-1] + edges[1:])
    curves = []
    for (name, values), (colour, _) in zip(groups.items(), looks(), strict=False):
        share = 100.0 * np.histogram(values, edges)[0] / values.size
        single = len(groups) == 1
        curves.append(Curve(middles, share, name, colour, "bars" if single else "marked"))
    return Panel(curves, "share of runs [%]", x_label=metric, legend=legend and len(groups) > 1)


def correlations(inputs: Mapping[str, Vector], values: Vector) -> dict[str, float]:
    """Return Spearman's rank correlation of `values` (n,) with each input (n,), NaN where one does not vary."""
    return {key: _spearman(np.asarray(x, float), np.asarray(values, float)) for key, x in inputs.items()}


def _spearman(x: Vector, y: Vector) -> float:
    from scipy.stats import rankdata

    known = np.isfinite(x) & np.isfinite(y)
    pair: Sequence[Vector] = (x[known], y[known])
    if known.sum() < 3 or any(np.ptp(v) == 0.0 for v in pair):
        return float("nan")
    return float(np.corrcoef(*(rankdata(v) for v in pair))[0, 1])
