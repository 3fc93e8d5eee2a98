"""The uncertain plant out of whatever users have, weights that cover it, and what does not fit."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import control
import numpy as np
import pytest

from softneck.core import DataError, SettingsError
from softneck.design import makeweight, uncertain_plant
from softneck.design.plants._uncertain import (
    ModelUncertainty,
    StepAndLoad,
    UncertainAxis,
    default_uncertainty,
    discretize_zoh,
    judge,
    sampling_line,
)
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
@pytest.mark.parametrize(("low", "high"), [(100.0, 0.5), (0.2, 3.0)])
def test_makeweight_passes_through_its_three_numbers(dt: float | None, low: float, high: float) -> None:
    W = makeweight(low, (3.0, 0.8), high, dt=dt)
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


# -- the step and the load --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["reference", "position_limit", "slew_limit", "load_at", "sample_time"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_a_test_has_sizes_and_times_above_zero(name: str, value: float) -> None:
    with pytest.raises(SettingsError, match=f"`{name}`"):
        StepAndLoad(**{name: value})


@pytest.mark.parametrize(("duration", "fits"), [(3.5, False), (3.4, False), (math.inf, False), (math.nan, False),
                                                (-1.0, False), (1e9, True), (3.5 + 1e-15, True)])  # fmt: skip
def test_a_test_ends_after_its_load_begins(duration: float, fits: bool) -> None:
    if fits:
        assert StepAndLoad(duration=duration).duration == duration
        return
    with pytest.raises(SettingsError, match=r"`duration` must be beyond `load_at` 3\.5 s"):
        StepAndLoad(duration=duration)


def test_the_test_of_the_neck_is_that_of_the_comparison_and_in_units_of_itself() -> None:
    """10 deg, 6 rad, 12.5 rad/s, half a radian at the input from 3.5 to 6 s, at 50 Hz."""
    test = StepAndLoad()
    assert math.degrees(test.reference) == pytest.approx(10.0)
    assert (test.position_limit, test.slew_limit / test.sample_time, test.load) == (6.0, 12.5, -0.5)
    assert (test.rows, test.load_row, test.gain_unit) == (301, 175, 1.0)
    # Twice the load for outputs that scale by 3: a scaled gain of 1 is 6.
    assert StepAndLoad(load=-1.0, size=3.0).gain_unit == 6.0
    assert (StepAndLoad(sample_time=0.5).rows, StepAndLoad(sample_time=0.5).load_row) == (13, 7)


def test_runs_are_judged_each_by_its_own_rows_before_and_from_the_load_on() -> None:
    test = StepAndLoad(reference=0.2, load_at=0.5, duration=0.9, sample_time=0.1)
    settled = [0.0, 0.1, 0.21, 0.19, 0.2]
    runs = {
        # (settling, overshoot, rms): within 5 % from the third sample; 5 % beyond; 0.02 and -0.04 rad of error.
        "settles": ([*settled, 0.2, 0.22, 0.2, 0.16, 0.2], 0.2, 5.0, math.degrees(math.sqrt((0.02**2 + 0.04**2) / 5))),
        "is there": ([0.2] * 10, 0.0, 0.0, 0.0),
        "leaves": ([0.2, 0.2, 0.2, 0.2, 0.2101, 0.2, 0.2, 0.2, 0.2, 0.2], math.inf, 5.05, 0.0),
        "jumps": ([0.0, 0.3, 0.2, 0.2, 0.2, 0.3, 0.3, 0.3, 0.3, 0.3], 0.2, 50.0, math.degrees(0.1)),
        "never": ([0.0] * 10, math.inf, 0.0, math.degrees(0.2)),
    }
    names = list(runs)
    for order in (names, names[::-1]):
        y = np.array([runs[name][0] for name in order])
        found = judge(y, y, test, order.index("settles"))
        np.testing.assert_allclose(found.settling, [runs[name][1] for name in order], atol=1e-12)
        np.testing.assert_allclose(found.overshoot, [runs[name][2] for name in order], atol=1e-9)
        np.testing.assert_allclose(found.load_rms, [runs[name][3] for name in order], atol=1e-12)
        assert found.row == pytest.approx(
            {"nominal_settling_s": 0.2, "worst_overshoot_pct": 50.0, "worst_load_rms_deg": math.degrees(0.2)}
        )


# -- what is allowed for ----------------------------------------------------------------------------------------------


def test_a_neck_is_allowed_the_dead_time_and_the_pole_of_the_paper_in_its_own_seconds() -> None:
    neck = Robot.preset("neck")
    assert default_uncertainty(neck) == ModelUncertainty(0.08, 5.293, 0.2)
    assert neck.time_constant_s is not None
    slow = replace(neck, time_constant_s=4.0 * neck.time_constant_s)
    found = default_uncertainty(slow)
    assert (found.least_delay, found.small_move_pole) == pytest.approx((0.32, 5.293 / 4.0))
    unknown: Any = SimpleNamespace(time_constant_s=None, tendon_angles=neck.tendon_angles)
    for other in (unknown, replace(Slide().robot, time_constant_s=0.5)):
        assert default_uncertainty(other) == ModelUncertainty(0.0, 0.0, 0.2)


def axis_of(*plants: AxisPlant, least: float = 0.0, pole: float = 0.0, spread: float = 0.2) -> UncertainAxis:
    return UncertainAxis(plants[0], plants, uncertainty=ModelUncertainty(least, pole, spread))


def described(axis: UncertainAxis) -> list[tuple[float, int, float]]:
    """Return gain over that of the neck's plant, delay and pole over its own, of every sample."""
    plain = bake_off_plant()
    return [(round(p.static_gain / plain.static_gain, 9), p.delay, round(plain.time_constant / p.time_constant, 9))
            for p in axis.samples]  # fmt: skip


def test_a_plant_alone_is_spread_to_both_ends_and_samples_of_its_own_are_kept() -> None:
    slow, late = bake_off_plant(0.5, 0.5), bake_off_plant(1.0, 1.0, 6)
    assert described(axis_of(slow).spread_gain()) == [(1.0, 4, 0.5), (0.8, 4, 0.5), (1.2, 4, 0.5)]
    assert described(axis_of(slow, spread=0.5).spread_gain()) == [(1.0, 4, 0.5), (0.5, 4, 0.5), (1.5, 4, 0.5)]
    assert described(axis_of(slow, spread=0.0).spread_gain()) == [(1.0, 4, 0.5)]
    # A later nominal plant and the small moves, each at both ends.
    both = axis_of(slow, least=0.1, pole=5.293).spread_gain()
    assert described(both) == [(1.0, 5, 0.5), (1.0, 5, 1.0), (0.8, 5, 0.5), (1.2, 5, 0.5), (0.8, 5, 1.0), (1.2, 5, 1.0)]
    assert both.nominal is both.samples[0]
    # Samples of its own: the nominal one alone is made later, and the small moves stand beside it.
    family = axis_of(slow, late, bake_off_plant(0.8, 0.5, 3), least=0.1, pole=5.293).spread_gain()
    assert described(family) == [(1.0, 5, 0.5), (1.0, 5, 1.0), (1.0, 6, 1.0), (1.6, 3, 0.5)]
    # What is fast and late enough already stays as it is.
    assert described(axis_of(late, least=0.1, pole=5.293).apply_assumptions()) == [(1.0, 6, 1.0)]
    assert described(axis_of(late, least=0.1, pole=-1.0).apply_assumptions()) == [(1.0, 6, 1.0)]


def test_what_is_assumed_is_told_of_each_axis_where_it_changes_something() -> None:
    fast, late, slow = bake_off_plant(1.0, 2.0, 4), bake_off_plant(1.0, 2.0, 9), bake_off_plant(1.0, 0.5, 9)
    early = bake_off_plant(1.0, 2.0, 3)
    delay, pole = {"least_delay": 0.08}, {"small_move_pole": 5.293}
    for pitch, roll, told in ((fast, late, {}), (early, late, delay), (late, early, delay), (late, slow, pole),
                              (slow, early, delay | pole)):  # fmt: skip
        plant = uncertain_plant({"pitch": pitch, "roll": roll})
        assert plant.assumptions() == told
        assert list(plant.assumptions()) == sorted(told)
        assert replace(plant, uncertainty=ModelUncertainty(0.08, 5.293)).assumptions() == {}
        assert plant.axis("roll").uncertainty == ModelUncertainty(0.08, 5.293)
    own = ModelUncertainty(0.02, 1.0, 0.1)
    assert replace(plant, uncertainty=own).axis("pitch").uncertainty is own
    with pytest.raises(SettingsError, match="axis"):
        plant.axis("yaw")


# -- whose plant it is ------------------------------------------------------------------------------------------------


class Slide:
    """A model of a robot with one motor and one output."""

    sample_time, directions = TS, np.eye(1)

    def __init__(self, gain: float = 1.0, *, limit: float = 5.0, **more: Any) -> None:
        self.robot = Robot.from_dict({
            "name": "slide", "motors": {"names": ["a"], "unit": "V", "setpoint_min": [-limit], "setpoint_max": [limit]},
            "outputs": {"names": ["x"], "unit": "mm"}, "directions": {"kind": "matrix", "matrix": [[1.0]]},
        })  # fmt: skip
        self.directions = np.array([[gain]])
        self.gain = gain
        vars(self).update(more)

    def tf(self, _output: str, /) -> control.TransferFunction:
        return control.TransferFunction([0.1 * self.gain], [1.0, -0.9], TS)


def test_of_several_models_the_first_says_whose_limits_and_directions_count() -> None:
    """Robots that differ in limits alone have one hash, and motors may be weighted otherwise."""
    wide, narrow = Slide(1.0, limit=5.0), Slide(2.0, limit=3.0)
    assert wide.robot.hash == narrow.robot.hash
    for models in ([wide, narrow], [narrow, wide]):
        plant = uncertain_plant(models)
        assert plant.robot is models[0].robot
        assert plant.weights is not None
        assert plant.weights.tolist() == [[models[0].gain]]
        assert [sample.static_gain for sample in plant.axis("x").samples] == pytest.approx([m.gain for m in models])
        assert plant.axes["x"].family == 2
    assert uncertain_plant(wide, narrow.robot).robot is narrow.robot
    other = Slide()
    other.robot = Robot.preset("arm")
    for act in (lambda: uncertain_plant([wide, other]),
                lambda: uncertain_plant(wide, Robot.preset("arm"))):  # fmt: skip
        with pytest.raises((DataError, SettingsError)):
            act()


def test_a_family_keeps_its_band_and_its_seconds_for_every_sample() -> None:
    lags = [control.TransferFunction([0.1 * k], [1.0, -0.9], TS) for k in (2, 3)]
    family = Slide(band=lambda axis: {"x": (0.5, 7.0)}[axis], samples=lambda _: lags)
    axis = uncertain_plant(family).axis("x")
    assert (axis.band, axis.family) == ((0.5, 7.0), 3)
    assert {sample.second for sample in axis.samples} == {axis.nominal.second}
    assert uncertain_plant(Slide()).axis("x").band is None
    assert uncertain_plant(Slide(band=None, samples=None)).axis("x").family == 1


@pytest.mark.parametrize("factor", [1.0 + 5e-10, 1.0 - 5e-10, 1.0 + 2e-9, 1.0 - 2e-9])
def test_sample_times_agree_to_a_billionth_in_and_between_axes(factor: float) -> None:
    same, plain, other = abs(factor - 1.0) < 1e-9, bake_off_plant(), bake_off_plant(sample_time=TS * factor)
    for source, message in (({"pitch": [plain, other], "roll": plain}, "sample 1 of pitch has a sample time"),
                            ({"pitch": plain, "roll": other}, "different sample times"),
                            ({"pitch": other, "roll": plain}, "different sample times")):  # fmt: skip
        if same:
            assert uncertain_plant(source).sample_time == pytest.approx(TS)
            continue
        with pytest.raises(SettingsError, match=message):
            uncertain_plant(source)


@pytest.mark.parametrize("gains", [(1.0, -1.0), (-1.0, 1.0), (1.0, 0.0), (0.0, 1.0)])
def test_samples_of_the_other_sign_or_of_none_are_refused_on_either_axis(gains: tuple[float, float]) -> None:
    first, second = (bake_off_plant(gain) for gain in gains)
    plain = bake_off_plant()
    for source in ({"pitch": [first, second], "roll": plain}, {"pitch": plain, "roll": [first, second]}):
        with pytest.raises(DataError, match="static gain"):
            uncertain_plant(source)
    both = {"pitch": [bake_off_plant(-1.0), bake_off_plant(-2.0)], "roll": plain}
    assert len(uncertain_plant(both).axis("pitch").samples) == 2


@pytest.mark.parametrize("axis", ["pitch", "roll"])
def test_signals_that_are_named_must_be_those_of_their_axis(axis: str) -> None:
    own = {"pitch": "theta_i", "roll": "phi_i"}
    other = "roll" if axis == "pitch" else "pitch"
    for names, right in (([own[axis]], [axis]), (["voltage"], [axis]), ([own[axis]], ["angle"])):
        source = {axis: tf(inputs=names, outputs=right), other: tf()}
        assert uncertain_plant(source).axis(axis).nominal.delay == 4
    for inputs, outputs in ((own[other], axis), (own[axis], other), (axis, axis), (own[axis], own[other])):
        with pytest.raises(SettingsError, match=f"a signal of {axis} is named"):
            uncertain_plant({axis: tf(inputs=[inputs], outputs=[outputs]), other: tf()})


def test_a_system_of_other_sizes_or_names_is_no_neck() -> None:
    three = control.append(control.ss(tf()), control.ss(tf()), control.ss(tf()))
    for source in (
        three,
        two_axes(["theta_i", "x"], ["pitch", "roll"]),
        two_axes(["theta_i", "phi_i"], ["pitch", "y"]),
    ):
        with pytest.raises(SettingsError, match="a design needs theta_i, phi_i"):
            uncertain_plant(source)


def test_rounding_of_a_state_space_leaves_no_coefficient() -> None:
    """Below 1e-11 of the largest a coefficient is rounding; above it is the plant's."""
    plain = bake_off_plant()
    found = uncertain_plant(control.ss(plain.tf())).axis("pitch").nominal
    np.testing.assert_allclose(found.numerator, plain.numerator, rtol=1e-9)
    np.testing.assert_allclose(found.denominator, plain.denominator, rtol=1e-9)
    assert (found.order, found.delay) == (1, 4)
    small = control.TransferFunction([1.0, 1e-9], [1.0, -0.9, 0.0], TS)
    assert uncertain_plant(control.ss(small)).axis("pitch").nominal.numerator.size == 2


# -- continuous plants ------------------------------------------------------------------------------------------------


def test_each_continuous_system_of_a_plant_is_held_and_a_discrete_one_is_left() -> None:
    lag, discrete = control.TransferFunction([2.0], [1.0, 4.0]), tf()
    for source in (lag, [discrete, lag], (lag,), {"pitch": discrete, "roll": [discrete, lag]}):
        period, _ = discretize_zoh(source, 0.1)
        assert period == 0.1
    for source in (discrete, [discrete], {"pitch": discrete}, 3.0, "x"):
        assert discretize_zoh(source, 0.1) == (None, source)
    _, held = discretize_zoh({"pitch": discrete, "roll": [discrete, lag]}, 0.1)
    assert held["pitch"] is discrete
    assert held["roll"][0] is discrete
    # K (1 - a)/(z - a) with a = exp(-p Ts).
    a = math.exp(-0.4)
    assert np.asarray(held["roll"][1].A).item() == pytest.approx(a)
    assert complex(held["roll"][1](1.0)).real == pytest.approx(0.5)
    for part in "ABCD":
        system = control.StateSpace(-1.0, 1.0, 1.0, 0.0)
        setattr(system, part, np.array([[math.nan]]))
        with pytest.raises(SettingsError, match="entries that are not finite"):
            discretize_zoh(system, 0.1)


def test_the_line_on_a_held_plant_is_of_its_period_wherever_it_stands() -> None:
    for design, told in (({"held_s": 0.02}, "20 ms"), ({"settings": {"sample_time": 0.5}}, "500 ms"),
                         ({"held_s": 0.02, "settings": {"sample_time": 0.5}}, "20 ms")):  # fmt: skip
        (line,) = sampling_line(design)
        assert f"held for {told} (exact)" in line
    for design in ({}, {"held_s": None, "settings": {"sample_time": 0.5}}, {"settings": {}}):
        assert sampling_line(design) == []
