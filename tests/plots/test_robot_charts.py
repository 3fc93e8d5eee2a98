"""Charts and pages of robots: a panel for each output, a curve for each motor, in the robot's units."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from softneck.core import DataError
from softneck.identification import OutputError, Validation, validate
from softneck.plots import quality_page
from softneck.plots._charts import recording_chart, residual_chart, validation_chart
from softneck.report import validation_page
from softneck.robot import Robot
from softneck.signals import Recording, assess_quality

from ..browser import charts_of

TS = 0.02
CHAMBERS = {
    "name": "chambers",
    "sample_time_s": TS,
    "motors": {"names": [f"p{j}" for j in range(5)], "unit": "bar"},
    "outputs": {"names": ["x", "y", "z"], "unit": "m", "display_unit": "mm"},
    "directions": {"kind": "identified"},
}


@pytest.fixture(scope="module")
def recording() -> Recording:
    robot, rng = Robot.from_dict(CHAMBERS), np.random.default_rng(0)
    u = np.repeat(rng.uniform(0.0, 2.0, (20, 5)), 20, axis=0)
    y = np.zeros((400, 3))
    for k in range(399):
        y[k + 1] = 0.8 * y[k] + 0.002 * u[k, :3] - 0.001 * u[k, 2:]
    y += 1e-5 * rng.standard_normal(y.shape)
    channels = dict(zip((*robot.set_points, *robot.outputs.names), (*1e5 * u.T, *y.T), strict=True))
    return Recording(np.arange(400) * TS, TS, channels, robot=robot)


def test_a_recording_has_all_motors_and_outputs_in_the_robot_s_units(recording: Recording) -> None:
    r = recording
    motors, outputs = recording_chart(r, "x").panels
    assert [curve.label for curve in motors.curves] == [f"p{j}" for j in range(5)]
    assert len({curve.colour for curve in motors.curves}) == 5
    assert (motors.y_label, outputs.y_label) == ("set-point [bar]", "output [mm]")
    np.testing.assert_allclose(motors.curves[4].y, r.set_points[:, 4] / 1e5)
    np.testing.assert_allclose(outputs.curves[2].y, 1e3 * r.outputs[:, 2])


def test_the_page_on_quality_is_of_any_robot(recording: Recording) -> None:
    found = assess_quality(recording, bandwidth=4.0)
    page = quality_page(recording, found, "mine")
    assert f">{recording.robot.set_points[4]}<" in page
    assert page.count('<li class="ok">') == sum(finding.severity == "ok" for finding in found.findings)


def test_a_validation_has_a_panel_and_an_error_for_each_output(recording: Recording) -> None:
    r = recording
    chart = validation_chart(r.time, r.outputs, {"free run": r.outputs + 1e-3}, "x", robot=r.robot)
    assert [panel.y_label for panel in chart.panels] == [
        label for name in "xyz" for label in (f"{name} [mm]", "error [mm]")
    ]
    np.testing.assert_allclose(chart.panels[5].curves[0].y, -1.0)


def test_residual_tests_of_a_robot_are_a_grid_of_its_outputs_and_motors(recording: Recording) -> None:
    lags = np.arange(3)
    own: Any = (lags, np.ones((3, 3)), np.ones(3))
    chart = residual_chart(own, (lags, np.ones((3, 5, 3)), np.ones((3, 5))), "x", robot=recording.robot)
    assert (chart.columns, len(chart.panels)) == (3, 18)
    assert chart.panels[17].title == "z: error with set-point p4 earlier"
    with pytest.raises(DataError, match=r"\(3, lags\) and \(3, 5, lags\)"):
        residual_chart(own, (lags, np.ones((2, 3, 3)), np.ones((2, 3))), "x", robot=recording.robot)


@pytest.mark.slow  # a runtime's text of its size is compiled
def test_the_page_of_a_validation_speaks_of_the_robot_s_outputs(recording: Recording) -> None:
    model = OutputError(delay=0.0).fit(recording)
    result: Validation = validate(model, recording, include_training=True, names=("m.npz", "r.csv"))
    page = validation_page([result])
    assert "in %, x/y/z" in page
    assert "Fit in % (from, to: its 95 % interval), errors in mm" in page
    assert "pitch" not in page.split('<script type="application/gzip"')[0] + charts_of(page)
