"""Slycot, which tests have and users do not, changes no design: python-control prefers it where it is installed."""

from __future__ import annotations

from typing import Any

import control
import numpy as np
import pytest

from softneck.core import SettingsError
from softneck.design import CustomSettings, HinfSettings, LqgSettings, PiSettings, makeweight
from softneck.identification import to_state_space
from softneck.robot import Directions, Motors, Outputs, Robot

TS = 0.02
PLANT = control.TransferFunction([0.0096], [1.0, -0.9, 0.0, 0.0, 0.0], TS)
INTEGRAL = control.TransferFunction([0.5, -0.45], [1.0, -1.0], TS)
# Two outputs over two motors, each entry with its own pole and dead time; one is a gain alone.
SQUARE = control.TransferFunction(
    [[[0.1], [0.02, 0.01]], [[0.3], [0.2]]],
    [[[1.0, -0.9], [1.0, -1.5, 0.7]], [[1.0], [1.0, -0.8, 0.0]]],
    TS, inputs=["a", "b"], outputs=["x", "y"],
)  # fmt: skip


@pytest.mark.parametrize(
    "settings",
    [HinfSettings(bandwidth=2.0), LqgSettings(), PiSettings(), CustomSettings(controller=INTEGRAL)],
    ids=lambda settings: settings.KIND,
)
@pytest.mark.parametrize("plant", [PLANT, control.ss(PLANT, method="scipy")], ids=["polynomials", "state space"])
def test_no_design_calls_slycot(plant: Any, settings: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    slycot = pytest.importorskip("slycot")
    for name in ("td04ad", "tb04ad"):
        monkeypatch.setattr(slycot, name, None)
    assert settings.design({"pitch": plant, "roll": plant}).ss().nstates
    assert makeweight(100.0, 2.0, 0.5, dt=TS).dt == TS


def test_a_matrix_of_transfer_functions_has_the_state_space_of_its_entries() -> None:
    system = to_state_space(SQUARE)
    z = np.exp(1j * TS * np.geomspace(0.1, 150.0, 20))
    # Rounding of ten states only.
    np.testing.assert_allclose(system(z), SQUARE(z), rtol=1e-11)
    assert (system.input_labels, system.output_labels) == (["a", "b"], ["x", "y"])


def test_a_plant_of_transfer_functions_is_that_of_its_state_space() -> None:
    G: Any = control.TransferFunction(
        [[[0.1], [0.02]], [[-0.03], [0.2]]], [[[1.0, -0.9], [1.0, -0.8]], [[1.0, -0.9], [1.0, -0.8]]], TS,
        inputs=["a", "b"], outputs=["x", "y"],
    )  # fmt: skip
    A, C = np.diag([0.9, 0.8]), np.array([[0.1, 0.02], [-0.03, 0.2]])
    system = control.StateSpace(A, np.eye(2), C, np.zeros((2, 2)), TS, inputs=["a", "b"], outputs=["x", "y"])
    motors = Motors(
        names=("a", "b"), unit="1", setpoint_min=(-1.0, -1.0), setpoint_max=(1.0, 1.0), rate_limit=(9.0, 9.0)
    )
    robot = Robot(
        name="stage",
        motors=motors,
        outputs=Outputs(names=("x", "y"), unit="1"),
        directions=Directions(kind="identified"),
    )
    ours, theirs = (LqgSettings().design(plant, robot=robot).ss() for plant in (G, system))
    z = np.exp(1j * TS * np.geomspace(0.5, 100.0, 10))
    # Twice the states, and the states that no input moves alone are estimated apart: equations solved to 1e-9.
    np.testing.assert_allclose(ours(z), theirs(z), rtol=1e-6)


def test_a_transfer_function_with_more_zeros_than_poles_has_none() -> None:
    with pytest.raises(SettingsError, match="more zeros than poles"):
        to_state_space(control.TransferFunction([1.0, 0.0], [1.0], TS))
