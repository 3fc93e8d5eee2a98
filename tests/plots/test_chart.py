"""Charts hold what they were given, and the matplotlib figure draws just that."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.patches import Rectangle

from softneck.core import DataError, SettingsError
from softneck.plots import Chart, Curve, Level, Panel, chart_figure
from softneck.plots._charts import loop_chart, recording_chart, timeline, validation_chart
from softneck.plots._recording_pages import faults_chart
from softneck.signals import SET_POINTS, Recording, assess_quality


def _wave(columns: int, rows: int = 100) -> np.ndarray:
    t = np.arange(rows) * 0.02
    return np.column_stack([np.sin(t + j) for j in range(columns)])


def test_a_figure_draws_the_very_numbers_of_a_chart() -> None:
    x = np.arange(5.0)
    curves = [Curve(x, x**2, style=style) for style in ("line", "dashed", "dotted", "points", "marked", "step")]
    figure = chart_figure(Chart("t", [Panel([curve], "y [deg]") for curve in curves]))
    for ax in figure.axes:
        np.testing.assert_array_equal(ax.lines[0].get_xydata(), np.column_stack([x, x**2]))
    assert [ax.get_xlabel() for ax in figure.axes] == [""] * 5 + ["time [s]"]


def test_bars_bands_and_levels_are_drawn() -> None:
    x = np.arange(4.0)
    curves = [Curve(x, x, style="bars"), Curve(x, -x, style="stems"), Curve(x, x - 1, style="band", upper=x + 1)]
    figure = chart_figure(Chart("t", [Panel(curves, "y", levels=(Level(0.5), Level(2.0, vertical=True)))]))
    (ax,) = figure.axes
    assert [bar.get_bbox().height for bar in ax.patches if isinstance(bar, Rectangle)] == x.tolist()
    assert len(ax.collections) == 2
    assert len(ax.lines) == 2


def test_panels_fill_columns_row_by_row() -> None:
    panels = [Panel([Curve(np.arange(3.0), np.arange(3.0))], str(k)) for k in range(3)]
    chart = Chart("t", panels, columns=2)
    assert chart.rows == 2
    assert [chart.x_label_of(k) for k in range(3)] == ["", "time [s]", "time [s]"]
    assert len(chart_figure(chart).axes) == 3


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        ({"style": "wavy"}, SettingsError, "`style` must be one of"),
        ({"style": "band"}, DataError, "belongs to a band"),
        ({"upper": np.zeros(3)}, DataError, "belongs to a band"),
        ({"y": np.zeros(4)}, DataError, "one shape"),
    ],
    ids=["style", "band without edge", "edge without band", "lengths"],
)
def test_a_curve_that_cannot_be_drawn_is_refused(arguments: dict, error: type[Exception], words: str) -> None:
    three: dict = {"x": np.zeros(3), "y": np.zeros(3)}
    with pytest.raises(error, match=words):
        Curve(**(three | arguments))


def test_a_chart_without_panels_is_refused() -> None:
    with pytest.raises(DataError, match="no panels"):
        Chart("t", [])
    with pytest.raises(DataError, match="at least 1"):
        Chart("t", [Panel([], "y")], columns=0)


def test_runs_that_start_anew_lie_behind_each_other_and_are_not_joined() -> None:
    time = np.tile(np.arange(50) * 0.02, 3)
    line = timeline(time, np.repeat([0, 1, 2], 50))
    assert (np.diff(line.x) > 0).all()
    assert line.moved
    values = line.spread(np.ones(150))
    assert np.isnan(values).sum() == 2
    # No row is lost, and each still follows its neighbour by one sample.
    np.testing.assert_array_equal(values[np.isfinite(values)], np.ones(150))
    kept = line.x[np.isfinite(values)]
    np.testing.assert_allclose(np.diff(kept).reshape(-1)[:49], 0.02, rtol=1e-12)


def test_a_gap_breaks_the_line_where_it_is() -> None:
    time = np.concatenate([np.arange(10), np.arange(30, 40)]) * 0.02
    line = timeline(time)
    assert not line.moved
    assert line.breaks.tolist() == [10]
    assert line.x[10] == pytest.approx(0.2)  # one sample behind the last row: a held value lasts that long
    assert line.x[11] == time[10]


def test_borders_of_runs_at_one_sample_time_come_from_the_run_numbers() -> None:
    assert timeline(np.arange(10) * 0.02, np.repeat([0, 1], 5)).breaks.tolist() == [5]
    with pytest.raises(DataError, match="runs of that shape"):
        timeline(np.arange(10.0), np.zeros(3))


def test_a_recording_is_drawn_with_held_set_points_in_degrees() -> None:
    chart = recording_chart(Recording.from_arrays(_wave(3), _wave(2), run=np.repeat([0, 1], 50)), "r")
    top, bottom = chart.panels
    assert {curve.style for curve in top.curves} == {"step"}
    y = bottom.curves[0].y
    np.testing.assert_array_equal(y[np.isfinite(y)], np.degrees(_wave(2)[:, 0]))
    assert len(top.levels) == 1


def test_the_error_is_measured_minus_predicted_and_bounds_are_a_band() -> None:
    t = np.arange(100) * 0.02
    y = _wave(2)
    predictions = {f"model {k}": (1 - 0.1 * k) * y for k in range(1, 9)}
    chart = validation_chart(t, y, predictions, "v", bounds=(y - 0.1, y + 0.1))
    pitch, error, *_ = chart.panels
    assert pitch.curves[0].style == "band"
    assert len(error.curves) == 8  # more models than colours: none is dropped, and no two look alike
    assert len({(curve.colour, curve.style) for curve in error.curves}) == 8
    np.testing.assert_allclose(error.curves[1].y, np.degrees(0.2 * y[:, 0]), atol=1e-12)


def test_a_run_that_goes_far_off_does_not_squeeze_what_was_measured() -> None:
    t, y = np.arange(100) * 0.02, 0.1 * _wave(2)
    near = validation_chart(t, y, {"good": 0.9 * y}, "v")
    far = validation_chart(t, y, {"bad": y + 3.0}, "v")
    assert near.panels[0].y_range is None
    assert far.panels[0].y_range is not None
    assert far.panels[0].y_range[1] < np.degrees(0.5)


def _drawn_spans(chart: Chart) -> list[float]:
    return [float(np.ptp(ax.get_ylim())) for ax in chart_figure(chart).axes]


def test_rounding_does_not_fill_a_panel_and_a_small_motion_does() -> None:
    """5e-16 deg is flat in every chart of measured channels; 0.1 deg is fitted as before."""
    time, wave = np.arange(100) * 0.02, np.sin(np.arange(100.0))
    signals = dict.fromkeys(SET_POINTS, wave)
    least = np.degrees(2 * 0.8 * 1e-4)  # of the outputs of the neck
    for size, flat in ((5e-16, True), (0.1, False)):
        y = np.radians(size) * wave
        measured = np.column_stack([wave, y])
        recording = Recording(time, 0.02, {**signals, "pitch": y, "roll": y})
        charts = {
            "loop": loop_chart(time, {**signals, "pitch": np.radians(wave), "roll": y}, "loop").panels[1],
            "recording": recording_chart(recording, "r").panels[1],
            "validation": validation_chart(time, measured, {"m": measured}, "v").panels[2],
            "error": validation_chart(time, measured, {"m": measured - y[:, None]}, "v").panels[1],
            "faults": faults_chart(recording, assess_quality(recording), "f").panels[-1],
        }
        for name, panel in charts.items():
            (drawn,) = _drawn_spans(Chart("one", [panel]))
            # Matplotlib adds 5 % of the range at each end; the wave misses its peaks by less than 1 %.
            assert drawn == pytest.approx(least if flat else 2.2 * size, rel=0.01), name
