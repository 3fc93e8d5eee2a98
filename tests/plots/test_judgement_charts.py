"""Charts of residual tests show the numbers that they were given."""

from __future__ import annotations

import numpy as np
import pytest

from softneck.core import DataError
from softneck.plots import chart_figure
from softneck.plots._charts import residual_chart

LAGS, CROSS_LAGS = np.arange(26), np.arange(-25, 26)


def _tests() -> tuple[tuple, tuple]:
    rng = np.random.default_rng(0)
    own = 0.02 * rng.standard_normal((2, 26))
    own[:, 0] = 1.0
    own[0, 3] = 0.2
    return (LAGS, own, np.full(2, 0.1)), (CROSS_LAGS, 0.02 * rng.standard_normal((2, 3, 51)), np.full((2, 3), 0.15))


def test_bars_beyond_their_bound_stand_out_and_lag_zero_is_no_news() -> None:
    own, cross = _tests()
    chart = residual_chart(own, cross, "r")
    assert len(chart.panels) == 8
    within, outside = chart.panels[0].curves
    assert 0.0 not in within.x
    np.testing.assert_array_equal(np.flatnonzero(np.isfinite(outside.y)), [2])  # lag 3
    np.testing.assert_array_equal(np.where(np.isfinite(within.y), within.y, outside.y), own[1][0, 1:])
    assert {level.value for level in chart.panels[0].levels} == {0.0, 0.1, -0.1}
    assert np.isnan(chart.panels[7].curves[1].y).all()
    for panel in chart.panels:
        # Bounds are seen even where no bar comes near them.
        assert panel.y_range is not None
        assert panel.y_range[1] > max(level.value for level in panel.levels)
    assert len(chart_figure(chart).axes) == 8


def test_too_few_rows_for_a_test_still_make_a_chart() -> None:
    own, cross = _tests()
    nothing = residual_chart((own[0], own[1] * np.nan, own[2] * np.nan), (cross[0], cross[1], cross[2] * np.nan), "r")
    assert len(nothing.panels[0].levels) == 1
    with pytest.raises(DataError, match="residual tests need correlations"):
        residual_chart((own[0][:3], own[1], own[2]), cross, "r")
