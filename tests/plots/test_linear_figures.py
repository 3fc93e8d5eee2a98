"""Charts of linear models: what was given is what is drawn."""

from __future__ import annotations

import numpy as np

from softneck.plots._charts import cover_chart, frequency_response_chart


def test_a_cover_draws_every_sample_under_the_weight() -> None:
    w = np.geomspace(0.1, 100, 30)
    (panel,) = cover_chart(w, np.full((3, 30), 0.2), np.full(30, 0.5), "pitch").panels
    assert [curve.label for curve in panel.curves] == ["samples", "", "", "|W|"]
    np.testing.assert_array_equal(panel.curves[-1].y, np.full(30, 0.5))


def test_a_response_is_drawn_in_its_circles_and_not_where_they_hold_zero() -> None:
    w = np.array([1.0, 2.0, 4.0])
    response = np.array([2.0, 1.0j, 0.1])
    gain, phase, _ = frequency_response_chart(
        w, response, np.array([1.0, 0.5, 0.2]), np.ones(3), "t", unit="deg/rad", models={"rls": 2.0 * response}
    ).panels
    band, data, model = gain.curves
    np.testing.assert_allclose(band.y, [1.0, 0.5, 1e-4])
    np.testing.assert_allclose(band.upper_edge, [3.0, 1.5, 0.3])
    np.testing.assert_allclose((data.y, 0.5 * model.y), (np.abs(response), np.abs(response)))
    np.testing.assert_allclose(phase.curves[1].y, [0.0, 90.0, np.nan])
    # A circle of half the size of the response is seen from zero under 2 arcsin(1/2).
    np.testing.assert_allclose((phase.curves[0].upper_edge - phase.curves[0].y)[:2], 60.0)
