"""The uncertain plant out of whatever users have, weights that cover it, and what does not fit."""

from __future__ import annotations

import math
from typing import Any

import control
import numpy as np
import pytest

from softneck.core import DataError, SettingsError
from softneck.design import makeweight, uncertain_plant
from softneck.design.plants._uncertain import UncertainAxis
from softneck.design.robust._weights import to_continuous, to_discrete, warp_frequency
from softneck.estimation import AxisPlant, LinearNeck
from softneck.robot import Robot

from ..oracles.bake_off import bake_off_neck, bake_off_plant, bake_off_samples

TS = 0.02


def tf(gain: float = 1.0, pole: float = 1.0, *, dt: float = TS, **names: Any) -> control.TransferFunction:
    plain = bake_off_plant(gain, pole, sample_time=dt).tf()
    return control.TransferFunction(plain.num, plain.den, dt, **names)


def two_axes(inputs: list[str], outputs: list[str]) -> control.StateSpace:
    made: Any = control.append(control.ss(tf()), control.ss(tf(0.8)))
    return control.StateSpace(made.A, made.B, made.C, made.D, TS, inputs=inputs, outputs=outputs)


@pytest.mark.parametrize(
    "source",
    [
        bake_off_neck(),
        tf(),
        control.ss(tf()),
        [tf(), tf(1.2), tf(1.0, 0.8)],
        bake_off_samples(),
        {"pitch": tf(), "roll": [tf(), tf(0.9)]},
        two_axes(["theta_i", "phi_i"], ["pitch", "roll"]),
        two_axes(["phi_i", "theta_i"], ["roll", "pitch"]),
        two_axes(["u[0]", "u[1]"], ["y[0]", "y[1]"]),
    ],
    ids=["model", "tf", "ss", "list", "mapping", "unequal", "named", "swapped", "unnamed"],
)
def test_a_plant_comes_in_many_forms(source: Any) -> None:
    plant = uncertain_plant(source)
    assert plant.sample_time == TS
    for name in ("pitch", "roll"):
        axis = plant.axis(name)
        assert axis.samples[0] is axis.nominal
        # The dead time is split off and stays whole, through state space as well.
        assert axis.nominal.delay == 4
    assert uncertain_plant(plant) is plant


def test_axes_are_found_by_name() -> None:
    straight = uncertain_plant(two_axes(["theta_i", "phi_i"], ["pitch", "roll"]))
    pitch, roll = (straight.axis(name).nominal.static_gain for name in ("pitch", "roll"))
    assert roll == pytest.approx(0.8 * pitch, rel=1e-6)
    swapped = uncertain_plant(two_axes(["phi_i", "theta_i"], ["roll", "pitch"]))
    pitch, roll = (swapped.axis(name).nominal.static_gain for name in ("pitch", "roll"))
    assert pitch == pytest.approx(0.8 * roll, rel=1e-6)


def test_it_has_the_face_of_a_family() -> None:
    plant = uncertain_plant(bake_off_samples())
    again = uncertain_plant(plant.__class__(plant.axes))
    assert len(again.samples("pitch")) == 75
    w = np.array([0.3, 3.0])
    z = np.exp(1j * w * TS)
    # The same coefficients.
    np.testing.assert_allclose(plant.tf("roll")(z), plant.axis("roll").nominal.response(w), rtol=1e-12)


UNSTABLE = control.TransferFunction([0.1], [1.0, -1.1], TS)


@pytest.mark.parametrize(
    ("source", "error", "message"),
    [
        ([], DataError, "list of samples is empty"),
        ({"pitch": tf()}, SettingsError, "must have the axes pitch and roll; got pitch"),
        ({"pitch": [], "roll": tf()}, DataError, "pitch has no samples"),
        (3.0, SettingsError, "a linear model is needed"),
        ({"pitch": 3.0, "roll": tf()}, SettingsError, "pitch must be a discrete control.StateSpace"),
        ([tf(), tf(dt=0.01)], SettingsError, r"sample 1 of pitch has a sample time of 0.01 s, the nominal plant 0.02"),
        ({"pitch": tf(), "roll": tf(dt=0.01)}, SettingsError, "different sample times"),
        ([tf(), UNSTABLE], SettingsError, r"the plant: the model's pitch is not stable \(spectral radius 1.1000\)"),
        (
            {"pitch": [tf(), UNSTABLE], "roll": tf()},
            SettingsError,
            "sample 1 of pitch: the model's pitch is not stable",
        ),
        ([tf(), tf(-1.0)], DataError, "sample 1 of pitch has a static gain of -.*no controller with integral action"),
        (control.TransferFunction([1.0], [1.0, 5.0]), SettingsError, "must be discrete"),
        (tf(inputs=["theta_i"], outputs=["pitch"]), SettingsError, "that of pitch alone; give both"),
        (two_axes(["a", "b"], ["pitch", "roll"]), SettingsError, "a, b to pitch, roll; a design needs theta_i, phi_i"),
        (
            {"pitch": tf(inputs=["phi_i"], outputs=["roll"]), "roll": tf()},
            SettingsError,
            "a signal of pitch is named phi_i; it must be theta_i",
        ),
        ({"pitch": two_axes(["a", "b"], ["c", "d"]), "roll": tf()}, SettingsError, "one input and one output; got 2"),
    ],
)
def test_what_does_not_fit_is_said(source: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        uncertain_plant(source)


def test_the_bilinear_map_is_exact_both_ways() -> None:
    G: Any = control.ss(bake_off_plant().tf())
    image: Any = to_continuous(G)
    w = np.geomspace(0.1, 150.0, 40)
    at = np.asarray(G(np.exp(1j * w * TS)))
    # Linear solves of order 5; the response falls to 1e-3 of its size.
    np.testing.assert_allclose(image(1j * warp_frequency(w, TS)), at, rtol=1e-9)
    back: Any = to_discrete(image, TS)
    np.testing.assert_allclose(back(np.exp(1j * w * TS)), at, rtol=1e-9)
    with pytest.raises(SettingsError, match="pole at z = -1"):
        to_continuous(control.TransferFunction([1.0], [1.0, 1.0], TS))


@pytest.mark.parametrize("dt", [None, TS])
@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize(("low", "high"), [(100.0, 0.5), (0.2, 3.0)])
def test_makeweight_passes_through_its_three_numbers(dt: float | None, order: int, low: float, high: float) -> None:
    W = makeweight(low, (3.0, 0.8), high, order=order, dt=dt)
    at = np.array([1e-9, 3.0]) if dt is None else np.array([1e-9, 3.0, math.pi / TS])
    sizes = np.abs(W(1j * at) if dt is None else W(np.exp(1j * at * TS)))
    # z - 1 loses digits at low frequencies.
    np.testing.assert_allclose(sizes[:2], [low, 0.8], rtol=1e-5)
    np.testing.assert_allclose(np.abs(W(1e12j)) if dt is None else sizes[2], high, rtol=1e-5)


def test_makeweight_says_what_it_cannot_do() -> None:
    with pytest.raises(SettingsError, match="must lie between"):
        makeweight(100.0, 3.0, 2.0)
    with pytest.raises(SettingsError, match="must be a finite number"):
        makeweight(math.inf, 3.0, 0.5)
    with pytest.raises(SettingsError, match="below the Nyquist frequency"):
        makeweight(100.0, 200.0, 0.5, dt=TS)


def test_a_list_of_models_is_their_samples() -> None:
    plant = uncertain_plant([bake_off_neck(), LinearNeck(pitch=tf(0.9), roll=tf(1.1))])
    assert [len(plant.samples(axis)) for axis in ("pitch", "roll")] == [2, 2]
    assert plant.axis("roll").samples[1].static_gain == pytest.approx(
        1.1 * plant.axis("roll").nominal.static_gain, rel=1e-12
    )


def test_a_family_of_outputs_of_any_name_has_its_samples() -> None:
    lag = control.TransferFunction([0.1], [1.0, -0.9], 0.02)
    robot = Robot.from_dict({
        "name": "slide", "motors": {"names": ["a"], "unit": "V"}, "outputs": {"names": ["x"], "unit": "mm"},
        "directions": {"kind": "matrix", "matrix": [[1.0]]},
    })  # fmt: skip

    class Slides:
        sample_time, directions = 0.02, np.eye(1)

        def __init__(self) -> None:
            self.robot = robot

        def tf(self, _output: str, /) -> control.TransferFunction:
            return lag

        def samples(self, _output: str) -> list[control.TransferFunction]:
            return [lag, 2.0 * lag]

    plant = uncertain_plant(Slides())
    assert plant.names == ("x",)
    assert [round(item.static_gain, 12) for item in plant.axis("x").samples] == [1.0, 1.0, 2.0]


def test_axes_are_the_same_only_where_every_plant_is() -> None:
    """One synthesis then does for both: another delay, numerator, denominator or number of samples is another axis."""

    def axis(*numbers: tuple[float, float, int]) -> UncertainAxis:
        plants = [AxisPlant(np.array([b]), np.array([1.0, a]), delay, TS) for b, a, delay in numbers]
        return UncertainAxis(plants[0], tuple(plants))

    one = axis((0.1, -0.9, 3), (0.2, -0.9, 3))
    assert one.same_as(axis((0.1, -0.9, 3), (0.2, -0.9, 3)))
    for other in (((0.1, -0.9, 4), (0.2, -0.9, 3)), ((0.1, -0.9, 3), (0.3, -0.9, 3)), ((0.1, -0.9, 3), (0.2, -0.8, 3)),
                  ((0.1, -0.9, 3),), ((0.2, -0.9, 3), (0.1, -0.9, 3))):  # fmt: skip
        assert not one.same_as(axis(*other))
