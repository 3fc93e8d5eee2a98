"""Figures of linear models: what was given is what is drawn."""

from __future__ import annotations

import numpy as np
from matplotlib.collections import LineCollection
from scipy.stats import norm

from softneck.plots import cover_figure, local_map_figure


def test_a_map_shows_degrees_and_milliseconds() -> None:
    numbers = np.array([[0.1, 5.0, 0.08], [0.09, 6.0, 0.1]])
    figure = local_map_figure({"0 g": (np.array([0.1, 0.3]), numbers, np.full((2, 4), 0.01))}, "pitch")
    scale = (np.degrees(1.0), 1.0, 1e3)
    for i, ax in enumerate(figure.axes):
        x, y = np.asarray(ax.lines[0].get_xdata(), float), np.asarray(ax.lines[0].get_ydata(), float)
        np.testing.assert_allclose(x, np.degrees([0.1, 0.3]))
        np.testing.assert_allclose(y, scale[i] * numbers[:, i])
        # Bars of 95 % of a normal distribution, to the three digits that are drawn.
        (bars,) = figure.axes[i].collections
        assert isinstance(bars, LineCollection)
        for k, segment in enumerate(bars.get_segments()):
            reach = scale[i] * 0.01 * norm.ppf(0.975)
            np.testing.assert_allclose(segment[:, 1], scale[i] * numbers[k, i] + reach * np.array([-1, 1]), rtol=1e-3)


def test_a_cover_draws_every_sample_under_the_weight() -> None:
    w = np.geomspace(0.1, 100, 30)
    figure = cover_figure(w, np.full((3, 30), 0.2), np.full(30, 0.5), "pitch")
    assert len(figure.axes[0].lines) == 4
    np.testing.assert_array_equal(figure.axes[0].lines[-1].get_ydata(), np.full(30, 0.5))
