"""The cost curves of a search over settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ._style import BLUE, GREY, ORANGE, label

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# Fits further below the best are no candidates and would flatten the curve.
_DEPTH = 25.0


def search_figure(curves: Mapping[str, Sequence[Sequence[Any]]], title: str, *, best: Mapping[str, Any]) -> Figure:
    """Draw for each varied setting its best free-run fit at each value, beside the one-step fit.

    Args:
        curves: setting -> rows (value, free-run fit of pitch, of roll, one-step fit of both) [%], None: no fit.
        title: of the figure.
        best: setting -> the chosen value.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 2.6 * len(curves) + 0.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(curves), 1, squeeze=False)[:, 0]
    fits = [fit for rows in curves.values() for row in rows for fit in row[1:3] if fit is not None]
    for ax, (name, rows) in zip(axes, curves.items(), strict=True):
        ax.grid(alpha=0.3)
        ax.spines[["top", "right"]].set_visible(False)
        # Values may be lags or names: they stand side by side in the order given.
        places = range(len(rows))
        for column, colour, style, text in (
            (1, BLUE, "o-", "pitch, free run"),
            (2, ORANGE, "o-", "roll, free run"),
            (3, BLUE, ":", "pitch, one step"),
            (4, ORANGE, ":", "roll, one step"),
        ):
            heights = [float("nan") if row[column] is None else row[column] for row in rows]
            ax.plot(places, heights, style, ms=4, lw=1.2, color=colour, label=text)
        values = [str(row[0]) for row in rows]
        ax.set_xticks(list(places), values)
        if str(best.get(name)) in values:
            ax.axvline(values.index(str(best[name])), color=GREY, lw=0.8, ls="--", label="chosen")
        if fits:
            ax.set_ylim(max(max(fits) - _DEPTH, min(fits) - 1.0), 101.0)
        ax.set_xlabel(name)
        label(ax, "fit on the hold-out [%]")
    figure.suptitle(title)
    return figure
