"""Pages stand on their own and escape what they are given."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from softneck.core import OutputFileError
from softneck.plots import (
    Section,
    Table,
    chart_figure,
    page,
)
from softneck.plots import write_page as write
from softneck.plots._charts import loop_chart
from softneck.robot import Robot


def test_text_is_escaped_and_verdicts_are_marked() -> None:
    table = Table("<b>", ["a"], [["holds"], ["fails"], ["<script>alert(1)</script>"]])
    html = page("<i>", [Section("s", text=["<u>"], tables=[table])])
    assert "<script>" not in html
    assert "<u>" not in html
    assert 'class="holds"' in html
    assert 'class="fails"' in html


@pytest.mark.parametrize("tension", [False, True], ids=["foreign plant", "virtual neck"])
def test_a_loop_is_drawn_with_what_the_plant_offers(tension: bool) -> None:
    signals = {f"motor_setpoint_{j}": np.zeros(50) for j in (1, 2, 3)} | {"pitch": np.ones(50), "roll": np.ones(50)}
    if tension:
        signals |= {f"tension_{j}": np.ones(50) for j in (1, 2, 3)}
    figure = chart_figure(loop_chart(np.arange(50) * 0.02, signals, "loop"))
    assert len(figure.axes) == (4 if tension else 3)


def test_a_loop_is_drawn_in_the_units_of_its_robot() -> None:
    table = Robot.preset("trunk4").as_dict()
    table["motors"] |= {"unit": "bar", "setpoint_min": 0, "setpoint_max": 3}
    table["outputs"] = {"names": ["x", "y"], "unit": "mm"}
    robot = Robot.from_dict(table)
    signals = {name: np.full(5, 2e5) for name in robot.set_points} | {"x": np.full(5, 0.004), "y_measured": np.ones(5)}
    x, y, motors = loop_chart(np.arange(5) * 0.02, signals, "loop", robot=robot).panels
    assert (x.y_label, y.y_label, motors.y_label) == ("x [mm]", "y [mm]", "motor [bar]")
    assert [curve.y[0] for curve in (*x.curves, *motors.curves)] == pytest.approx([4.0, 2.0, 2.0, 2.0, 2.0])


def test_an_existing_page_is_kept_without_force(tmp_path: Path) -> None:
    target = tmp_path / "report.html"
    write(target, "first")
    with pytest.raises(OutputFileError, match="exists already"):
        write(target, "second")
    assert target.read_text(encoding="utf-8") == "first"
