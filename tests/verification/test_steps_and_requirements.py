"""Steps measured as the loop measures them, requirements at their borders, boxes and their plants counted by hand."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import control
import numpy as np
import pytest

from softneck.core import DataError, FileFormatError, SettingsError, silent, to_json
from softneck.core._certificate import required_rows
from softneck.design import grid_response
from softneck.estimation import LinearNeck
from softneck.loop import LoopResult, metrics
from softneck.robot import Robot
from softneck.verification import (
    Scale,
    _plants,
    _steps,
    make_requirements,
    metric_names,
    metric_title,
    read_requirements,
)
from softneck.verification._evidence import _linear_evidence
from softneck.verification._linear import LinearLaw, controller_under_test, frequency_grid
from softneck.verification._plants import (
    all_plants,
    join,
    make_plants,
    nominal_plants,
    source_of_family,
    source_of_model,
    within_weight,
)
from softneck.verification._requirements import Requirement, apply_safety_margin, expand_metrics, select_for_verify
from softneck.verification._steps import StepTest, _metrics, check_ports, middle_motors, middle_of, run_steps
from softneck.verification._verify import sources_of

from .necks import TS, controller_of, family, linear_neck, pi

SPREAD = {"gain": 0.2, "pole": 0.3, "delay": 0.02}


# -- steps ------------------------------------------------------------------------------------------------------------


def _second_order(damping: float, frequency: float, rows: int) -> np.ndarray:
    t = np.arange(rows) * TS
    root = frequency * math.sqrt(1.0 - damping**2)
    return 1.0 - np.exp(-damping * frequency * t) * (np.cos(root * t) + damping * frequency / root * np.sin(root * t))


def test_a_step_is_measured_as_the_loop_measures_it() -> None:
    """Two programs, one definition: rise, settling, overshoot and steady error of the same rows."""
    half, size = 200, 0.2
    first = np.stack([size * _second_order(zeta, w, half) for zeta, w in product((0.2, 0.5, 0.9), (2.0, 5.0, 9.0))])
    y = np.concatenate([first, first[:, -1:] + np.linspace(0.0, 0.05, half)], axis=1)
    other = np.tile(np.linspace(-0.01, 0.005, half), (len(y), 1))
    found = _metrics(y, other, StepTest(step=size, duration=half * TS, noise=0.0, load=0.0, seed=0), half, TS)
    zero = np.zeros(half)
    for row in range(len(y)):
        signals = {"pitch": first[row], "pitch_reference": np.full(half, size), "roll": zero, "roll_reference": zero}
        signals |= {f"motor_setpoint_{j}": zero for j in (1, 2, 3)}
        table = metrics(LoopResult(np.arange(half) * TS, signals, {}, TS))["pitch"]
        for name in ("rise_s", "settling_s", "overshoot_pct", "steady_rms_deg"):
            expected = math.inf if table[name] is None else table[name]
            # The same samples are chosen; sums and differences of times are rounded.
            assert found[name][row] == pytest.approx(expected, rel=1e-9, abs=1e-12), (row, name)
        load = np.degrees(np.sqrt(np.mean((y[row, half:] - size) ** 2)))
        assert found["load_rms_deg"][row] == pytest.approx(load, rel=1e-12)
    np.testing.assert_allclose(found["coupling_deg"], math.degrees(0.01), rtol=1e-12)


def test_what_never_arrives_or_overflows_is_infinite() -> None:
    half = 50
    y = np.full((4, 2 * half), 0.05)
    y[1] = np.inf
    y[2, 10:] = 0.2
    y[3] = 0.2
    other = np.zeros((4, half))
    found = _metrics(y, other, StepTest(step=0.2, duration=1.0, noise=0.0, load=0.0, seed=0), half, TS)
    assert np.isinf(found["rise_s"]).tolist() == [True, True, False, False]
    assert np.isinf(found["settling_s"]).tolist() == [True, True, False, False]
    assert all(np.isinf(values[1]) for values in found.values())
    # The third stands at 25 % from the start, which is beyond 10 %, and arrives in row 10.
    assert (found["rise_s"][2], found["settling_s"][2]) == pytest.approx((10 * TS, 10 * TS))
    assert (found["settling_s"][3], found["overshoot_pct"][3]) == (0.0, 0.0)


def test_a_load_comes_in_the_second_half_on_the_stepped_axis_alone_and_noise_scales() -> None:
    plants = nominal_plants([source_of_family(family(), "f")])[0]
    block = pi().block()

    def run(**changes: float) -> Any:
        values = {"step": 0.2, "duration": 2.0, "noise": 0.0, "load": 0.0, **changes}
        return run_steps(plants, block, StepTest(seed=3, **values))

    calm, loaded = run(), run(load=0.05)
    half = 100
    assert calm.time.size == 2 * half
    assert calm.time[1] == TS
    delay = int(plants.delay.max())
    for axis in (0, 1):
        np.testing.assert_array_equal(
            loaded.angles[axis, :, : half + 1 + delay], calm.angles[axis, :, : half + 1 + delay]
        )
        assert np.abs(loaded.angles[axis] - calm.angles[axis]).max() > 1e-3
    assert loaded.metrics["overshoot_pct"] == pytest.approx(calm.metrics["overshoot_pct"])
    one, two = (run(noise=size).angles - calm.angles for size in (1e-6, 2e-6))
    # A linear loop inside its limits: twice the noise, twice its effect; rounding of 0.2 against 1e-6.
    np.testing.assert_allclose(two, 2.0 * one, rtol=0.0, atol=1e-12)
    assert run(noise=1e-3).angles.tolist() == run(noise=1e-3).angles.tolist()
    # The worse axis stands in the table, and is named.
    assert set(np.unique(calm.worse["rise_s"])) <= {0, 1}


# -- requirements -----------------------------------------------------------------------------------------------------


def test_a_bound_holds_at_its_limit_except_below() -> None:
    for bound, values in {
        "min": (False, True, True), "max": (True, True, False), "below": (True, False, False),
    }.items():  # fmt: skip
        item = Requirement("m", bound, 1.5, True)
        assert tuple(item.holds(value) for value in (1.5 - 1e-12, 1.5, 1.5 + 1e-12)) == values
        assert not item.holds(math.nan)


@pytest.mark.parametrize(
    ("table", "key", "low", "high"),
    [
        ("uncertainty", "gain_pct", 0.0, 95.0), ("uncertainty", "pole_pct", 0.0, 95.0),
        ("uncertainty", "delay_ms", 0.0, 1e9), ("uncertainty", "rolloff_db_per_decade", -1.0, 200.0),
        ("sampling", "plants", 1, 100_000),
        ("sampling", "search_generations", 0, 10_000), ("sampling", "seed", 0, 2**31 - 2),
        ("step", "size_deg", 0.01, 45.0), ("step", "duration_s", 1e-3, 1e6), ("step", "noise_deg", 0.0, 10.0),
        ("step", "load_rad", -6.0, 6.0), ("sim", "necks", 0, 1000), ("sim", "spread_pct", 0.0, 50.0),
        ("sim", "size_deg", 0.01, 45.0), ("sim", "duration_s", 1e-3, 1e6), ("sim", "taut_up_to_kg", 0.0, 5.0),
    ],
)  # fmt: skip
def test_numbers_of_the_tables_have_their_ranges(table: str, key: str, low: float, high: float) -> None:
    # A short run is no test of settling, which is refused by itself.
    free = {"step.settling_s": False, "sim.settling_s": False} if key == "duration_s" else {}
    for value in (low, high):
        assert getattr(make_requirements({table: {key: value}, "require": free}), table)[key] == value
    step = 1 if isinstance(low, int) else 1e-6
    for wrong in (low - step, high + step, True, "1"):
        with pytest.raises(SettingsError):
            make_requirements({table: {key: wrong}})


@pytest.mark.parametrize(("key", "most"), [("payloads_kg", 5.0), ("orientations_deg", 360.0)])
def test_lists_of_numbers_have_theirs(key: str, most: float) -> None:
    assert make_requirements({"sim": {key: [0.0, most]}}).sim[key] == [0.0, most]
    for wrong in ([most + 1e-6], [-1e-6], [], 1.0, [True]):
        with pytest.raises(SettingsError):
            make_requirements({"sim": {key: wrong}})


@pytest.mark.parametrize(
    ("require", "possible"),
    [
        ({"axes.sensitivity": {"max": 1.0}}, True),
        ({"axes.sensitivity": {"max": 1.0 - 1e-9}}, False),
        ({"axes.gain_margin": {"max": 1.0}, "axes.sensitivity": False}, True),
        ({"axes.gain_margin": {"max": 1.0 - 1e-9}, "axes.sensitivity": False}, False),
        ({"axes.disk_margin": {"min": 2.0}, "axes.sensitivity": False}, True),
        ({"axes.disk_margin": {"min": 2.0 + 1e-9}, "axes.sensitivity": False}, False),
        ({"step.rise_s": {"min": 1.0, "max": 1.0}}, True),
        ({"step.rise_s": {"min": 1.0, "max": 1.0 - 1e-9}}, False),
        ({"roll.gain_margin": {"max": 3.0}, "axes.gain_margin": {"min": 3.0}, "axes.sensitivity": {"max": 1.5}}, True),
    ],
)
def test_what_no_loop_can_do_is_refused_at_the_border(require: dict[str, Any], possible: bool) -> None:
    if possible:
        assert make_requirements({"require": require}).bounds
    else:
        with pytest.raises(SettingsError):
            make_requirements({"require": require})


@pytest.mark.parametrize(
    ("table", "right"),
    [
        *(
            ({"require": {metric: {bound: limit}}}, right)
            for metric, bound, inside, beyond in (
                ("axes.phase_margin_deg", "max", 179.9, 180.0), ("roll.disk_margin", "max", 1.99, 2.0),
                ("axes.gain_margin", "min", 1.01, 1.0), ("pitch.sensitivity", "min", 1.01, 1.0),
                ("step.rise_s", "min", 0.01, 0.0), ("stability.radius", "max", 1.0, 1.01),
                ("robust.mu", "below", 1.0, 1.01), ("stability.searched_radius", "max", 1.0, 1.01),
                ("step.settling_s", "max", 4.0, 4.01), ("sim.settling_s", "max", 5.0, 5.01),
                ("step.rise_s", "min", 2.0, 2.01),
            )
            for limit, right in ((inside, True), (beyond, False))
        ),
        *(({"require": {"step.rise_s": wrong}}, False)
          for wrong in ({}, {"most": 1.0}, {"max": math.nan}, {"max": math.inf}, {"max": True}, 1.0)),
        ({"uncertainty": {"gain_pct": 1.0}}, True), ({"uncertainty": {"gain_pct": 0.99}}, False),
        ({"uncertainty": {"pole_pct": 1.0}}, True), ({"uncertainty": {"pole_pct": 0.2}}, False),
        ({"sim": {"preset": 5}}, False), ({"sim": {"decides": 1}}, False), ({"sim": {"taut_up_to_kg": 5.01}}, False),
        ({"simm": {}}, False), ({"sim": 5}, False), ({"require": {"axes.rise_s": {"max": 1.0}}}, False),
        ({"require": dict.fromkeys(metric_names(Robot.preset()), False)}, False),
    ],
    ids=str,
)  # fmt: skip
def test_a_requirement_that_always_holds_or_means_nothing_is_refused(table: dict[str, Any], right: bool) -> None:
    if right:
        assert make_requirements(table).bounds
    else:
        with pytest.raises(SettingsError):
            make_requirements(table)


@pytest.mark.parametrize("reserve", [True, "1", -0.1, math.nan, math.inf, 0.5, 0.6])
def test_a_safety_margin_that_is_none_is_refused(reserve: Any) -> None:
    with pytest.raises(SettingsError):
        apply_safety_margin({"sim.rise_s": {"max": 0.5}}, {"sim.rise_s": reserve})


def test_safety_margins_are_taken_off_the_limits_that_they_name() -> None:
    require = {"sim.rise_s": {"max": 0.5, "min": 0.1}, "sim.max_rad": False, "track.circle_rms_deg": {"max": 3.0}}
    less, kept = apply_safety_margin(require, {"sim.max_rad": 1.0, "sim.rise_s": 0.1, "track.circle_rms_deg": 0.0})
    assert less == {**require, "sim.rise_s": {"max": 0.4, "min": 0.1}}
    assert kept == {"sim.rise_s": 0.1}
    for reserve, asked in (({"axes.sensitivity": 0.1}, {"axes.sensitivity": {"max": 2.0}}), ({"sim.rise_s": 0.1}, {}),
                           (5, {}), ({}, 5)):  # fmt: skip
        with pytest.raises(SettingsError):
            apply_safety_margin(asked, reserve)  # pyright: ignore[reportArgumentType]
    own = {"require": {**require, "sim.rise_s": {"max": 0.5}}, "reserve": {"sim.rise_s": 0.1}, "track": {}, "sim": {}}
    assert select_for_verify(own) == {"require": {"sim.rise_s": {"max": 0.4}, "sim.max_rad": False}, "sim": {}}


def test_a_flat_table_is_of_simulation_models_where_there_are_any() -> None:
    def flat(stepping: bool, **table: Any) -> Any:
        return expand_metrics(table, Robot.preset(), stepping=stepping)

    assert flat(True, overshoot_pct=5) == {"require": {"sim.overshoot_pct": {"max": 5}}}
    assert flat(False, overshoot_pct=5) == {"require": {"step.overshoot_pct": {"max": 5}}}
    found = flat(False, gain_margin=2, mu={"below": 1}, sampling={"seed": 3}, require={"step.rise_s": 1})
    assert found == {
        "sampling": {"seed": 3},
        "require": {"step.rise_s": 1, "axes.gain_margin": {"min": 2}, "robust.mu": {"below": 1}},
    }
    assert flat(True, slack_s=False)["require"] == {"sim.slack_s": False}
    # A table that nobody knows is left to be refused, and hides no limit that stands after it.
    found = flat(False, stepp={"size_deg": 9.0}, gain_margin=2)
    assert found == {"stepp": {"size_deg": 9.0}, "require": {"axes.gain_margin": {"min": 2}}}
    for wrong in ({"overshot_pct": 5}, {"rise_s": 1, "require": 5}):
        with pytest.raises(SettingsError):
            flat(True, **wrong)
    with pytest.raises(SettingsError, match="a file or a table"):
        read_requirements(5)  # pyright: ignore[reportArgumentType]


def test_where_draws_decide_the_error_under_the_load_is_asked_of_their_loops_too() -> None:
    plain = make_requirements({"require": {"step.load_rms_deg": {"max": 1.5}}})
    more = plain.over_draws()
    assert more.bounds[: len(plain.bounds)] == plain.bounds
    assert more.bounds[len(plain.bounds) :] == (Requirement("sim.load_rms_deg", "max", 1.5, True),)
    own = make_requirements({"require": {"sim.load_rms_deg": {"max": 1.0}}})
    assert own.over_draws() is own


def test_limits_of_a_robot_scale_by_time_size_load_and_noise_each_where_it_belongs() -> None:
    scale = Scale(time=2.0, size=3.0, load=4.0, noise=5.0)
    factors = {"load_rad": 4.0, "noise_deg": 5.0, "circle_rad_s": 0.5, "size_deg": 3.0, "steady_rms_deg": 5.0,
               "settling_s": 2.0, "delay_ms": 2.0, "orientations_deg": 1.0, "phase_margin_deg": 1.0,
               "mu": 1.0}  # fmt: skip
    assert {name: scale.factor(name) for name in factors} == factors
    assert Scale(size=3.0, noise=1.0).factor("steady_rms_deg") == 3.0
    given = {"settling_s": {"max": 1.0, "min": 3}, "delay_ms": True, "mu": 7.0, "sim.rise_s": [1.0], "size_deg": "x"}
    assert scale.table(given) == {**given, "settling_s": {"max": 2.0, "min": 6.0}}
    robot = Robot.preset("finger")
    other = Scale.of(robot)
    assert other.noise == pytest.approx(other.size if robot.noise_std is None else other.noise)
    assert (Scale.of(Robot.preset()).size, Scale.of(Robot.preset()).noise) == (pytest.approx(1.0), pytest.approx(1.0))
    # A scale that is known stays; that of another robot has its own defaults.
    asked = make_requirements({"require": {"step.settling_s": {"max": 1.0}}})
    assert asked.at(Scale(time=9.0)) is asked
    unknown = make_requirements({}, scale=Scale(known=False))
    assert unknown.at(Scale(time=9.0)).scale.time == 9.0
    assert asked.at(other).scale is other


def test_numbers_of_another_robot_have_the_ranges_of_the_neck_s_by_its_scale() -> None:
    """Where neither robot nor plants give the scale, a size must be positive, and a load any number."""
    robot = Robot.preset("finger")
    known = Scale(robot=robot, time=2.0, size=3.0, load=4.0, noise=2.0, known=True)
    unit = known.name_of("size_deg").rpartition("_")[2]
    for key, low, high in ((f"size_{unit}", 0.03, 135.0), ("duration_s", 2e-3, 2e6), (f"noise_{unit}", 0.0, 30.0)):
        free = {"step.settling_s": False}
        for value in (low, high):
            assert make_requirements({"step": {key: value}, "require": free}, scale=known).bounds
        for wrong in (low - 1e-3, high * 1.001):
            with pytest.raises(SettingsError):
                make_requirements({"step": {key: wrong}, "require": free}, scale=known)
    unknown = replace(known, known=False)
    load = known.name_of("load_rad")
    assert make_requirements({"step": {f"size_{unit}": 1e9, load: -1e9}}, scale=unknown).bounds
    with pytest.raises(SettingsError):
        make_requirements({"step": {f"size_{unit}": -1.0}}, scale=unknown)
    with pytest.raises(SettingsError):
        make_requirements({"step": {load: -24.1}}, scale=known)


def test_a_model_without_requirements_is_certain_and_what_is_no_plant_is_refused() -> None:
    [source] = sources_of({"m": linear_neck()})
    for box in source.axes:
        np.testing.assert_array_equal(box.low, box.nominal)
        np.testing.assert_array_equal(box.high, box.nominal)
    [wide] = sources_of({"m": linear_neck()}, make_requirements({"uncertainty": {"gain_pct": 10.0, "delay_ms": 40.0}}))
    assert wide.axes[0].high[0] == pytest.approx(1.1 * wide.axes[0].nominal[0])
    assert wide.axes[0].high[1] == pytest.approx(1.2 * wide.axes[0].nominal[1])
    assert wide.axes[0].high[2] == pytest.approx(0.04 + wide.axes[0].nominal[2])
    for things in ({}, {"x": object()}):
        with pytest.raises(SettingsError):
            sources_of(things)


def test_json_values_of_everything_and_nothing_else() -> None:
    values = {"a": np.array([1.0, math.inf]), 2: (True, np.bool_(False)), "n": np.int64(3), "x": math.nan, "t": "s"}
    assert to_json(values) == {"a": [1.0, None], "2": [True, False], "n": 3, "x": None, "t": "s"}
    assert to_json(True) is True
    assert to_json(None) is None
    with pytest.raises(DataError):
        to_json(object())


# -- boxes and plants -------------------------------------------------------------------------------------------------


def test_the_box_of_a_model_is_its_spread_around_it() -> None:
    neck = source_of_model(linear_neck(), "m", SPREAD)
    for box in neck.axes:
        K, p, L = box.nominal
        np.testing.assert_allclose(box.low, [0.8 * K, 0.7 * p, L - 0.02], rtol=1e-12)
        np.testing.assert_allclose(box.high, [1.2 * K, 1.3 * p, L + 0.02], rtol=1e-12)
        np.testing.assert_allclose(box.middle, box.nominal, rtol=1e-12)
        np.testing.assert_allclose(box.widths, [0.2 * K, 0.3 * p, 0.02], rtol=1e-9)
    # A dead time is never negative.
    assert source_of_model(linear_neck(delay=0), "m", SPREAD).axes[0].low[2] == 0.0


def test_all_plants_are_the_nominal_both_sets_of_corners_the_samples_and_what_lies_inside() -> None:
    found = family(count=6)
    neck = source_of_family(found, "f")
    plants = all_plants([neck], 40, 0)
    # 1 nominal, 8 corners twice, 6 samples, and 17 from inside the box.
    assert [sum(word in name for name in plants.names) for word in ("nominal", "corner", "sample", "inside")] == [
        1, 16, 6, 17,
    ]  # fmt: skip
    corners = plants.numbers[1:17]
    for i, box in enumerate(neck.axes):
        assert {tuple(row) for row in corners[:, i]} == set(product(*zip(box.low, box.high, strict=True)))
        inside = plants.numbers[23:, i]
        assert np.all((inside > box.low) & (inside < box.high))
        # A Latin hypercube has one in each of 17 slices of each number.
        slices = np.floor(17 * (inside - box.low) / (box.high - box.low)).astype(int)
        assert all(sorted(column) == list(range(17)) for column in slices.T)
    same = corners[::2]
    np.testing.assert_allclose(same[:, 0], same[:, 1], rtol=0.5)
    assert len(all_plants([neck], 1, 0)) == 23
    both = all_plants([neck, neck], 60, 0)
    assert np.bincount(both.source).tolist() == [30, 30]
    assert plants.take(3).names == (plants.names[3],)


def test_joined_plants_respond_as_each_alone() -> None:
    w = frequency_grid(TS, 20)
    one = nominal_plants([source_of_model(linear_neck(), "m", SPREAD)])[0]
    two = all_plants([source_of_family(family(cross=0.1), "f")], 1, 0)
    both = join([one, two])
    np.testing.assert_allclose(both.response(w), np.concatenate([one.response(w), two.response(w)]), rtol=1e-12)
    np.testing.assert_array_equal(both.cross, np.concatenate([one.cross, two.cross]))
    # One sample of delay more turns the phase by w Ts and changes no size.
    np.testing.assert_allclose(both.later(1).response(w), both.response(w) * np.exp(-1j * w * TS), rtol=1e-12)


def test_steps_of_the_first_plants_are_theirs_whatever_directions_a_further_model_has() -> None:
    controller = controller_under_test(pi(), order=None, observer=False)
    asked = make_requirements({"sampling": {"plants": 1, "search_generations": 0}, "step": {"noise_deg": 0.0}})
    one, other = sources_of({"one": linear_neck(), "other": linear_neck()}, asked)
    turned = replace(other, weights=one.weights[::-1])
    alone, both = (_linear_evidence(controller, necks, asked, silent, {}) for necks in ([one], [one, turned]))
    first = both.stepped.source == 0
    assert 0 < first.sum() < first.size
    np.testing.assert_array_equal(both.steps.angles[:, first], alone.steps.angles)


def test_frequencies_go_up_to_nyquist() -> None:
    w = frequency_grid(TS)
    assert (w[0], w[-1]) == pytest.approx((0.02, math.pi / TS))
    assert w.size == 360


def test_the_static_gain_of_a_plant_is_its_number() -> None:
    neck = source_of_model(linear_neck(), "m", SPREAD)
    numbers = np.array([[[0.1, 5.0, 0.05], [-0.2, 3.0, 0.071]]])
    plants = make_plants(neck, numbers, [""])
    low = plants.response(np.array([1e-6]))[0, :, 0]
    np.testing.assert_allclose(low, [0.1, -0.2], rtol=1e-5)
    # Between samples the dead time counts too: the phase at low frequencies is -w (L + Ts/2 + 1/p).
    w = 0.01
    turned = -np.angle(plants.response(np.array([w]))[0, :, 0] / numbers[0, :, 0]) / w
    np.testing.assert_allclose(turned, [0.05 + TS / 2 + 1 / 5.0, 0.071 + TS / 2 + 1 / 3.0], rtol=1e-3)


def test_a_controller_is_coupled_where_one_angle_moves_the_others_input() -> None:
    law = LinearLaw.of(controller_of(np.array([1.0, -0.9]), np.array([1.0, -0.5])))
    assert not law.coupled
    coupled = LinearLaw(law.A, law.Br, law.By, law.C, law.Dr, law.Dy + np.array([[0.0, 1e-6], [0.0, 0.0]]), TS)
    assert coupled.coupled
    w = frequency_grid(TS, 15)
    z = np.exp(1j * w * TS)
    np.testing.assert_allclose(law.feedback(w)[:, 0, 0], -(z - 0.9) / (z - 0.5), rtol=1e-12)
    assert np.abs(grid_response(law.A, law.Br, law.C, law.Dr, z)).max() == 0.0


def test_files_of_before_say_neck_for_what_is_sim_now() -> None:
    asked = {"{0}": {"necks": 2}, "require": {"{0}.rise_s": {"max": 0.7}}}
    old, new = (make_requirements(json.loads(json.dumps(asked).replace("{0}", name))) for name in ("neck", "sim"))
    assert old.bounds == new.bounds
    assert old.sim == new.sim
    rows = required_rows({"requirements": [{"metric": "neck.slack_s", "holds": True}]})
    assert [row["metric"] for row in rows] == ["sim.slack_s"]


@pytest.mark.parametrize("robot", ["neck", "arm"])
def test_every_metric_has_a_plain_name_of_its_own_beside_its_key(robot: str) -> None:
    metrics = metric_names(Robot.preset(robot), track=True)
    titles = [metric_title(metric) for metric in metrics]
    assert all(title.endswith(f" ({metric})") for title, metric in zip(titles, metrics, strict=True))
    assert len({title.rpartition(" (")[0] for title in titles}) == len(titles)
    assert metric_title("axes.gain_margin") == "gain margin, worst axis (axes.gain_margin)"


# -- channels, scales and weights -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["pitch_reference", "roll_reference", "pitch", "roll", "motor_setpoint_1", "motor_setpoint_3"]
)
def test_a_controller_must_have_every_channel_of_its_robot(name: str) -> None:
    block = pi().block()
    check_ports(block, Robot.preset())
    kept = {what: tuple(port for port in getattr(block, what) if port.name != name) for what in ("inputs", "outputs")}
    with pytest.raises(
        SettingsError, match=f"has no channel `{name}`; softneck verifies controllers from pitch, roll and"
    ):
        check_ports(SimpleNamespace(kind="pi", **kept), Robot.preset())  # pyright: ignore[reportArgumentType]


CART = Robot.from_dict({
    "name": "cart", "directions": {"kind": "matrix", "matrix": [[1.0, 0.5], [0.0, 1.0]]},
    "motors": {"names": ["a", "b"], "unit": "V", "setpoint_min": [-2.0, -2.0], "setpoint_max": [2.0, 6.0]},
    "outputs": {"names": ["x", "y"], "unit": "mm"},
})  # fmt: skip


def source_with(*axes: tuple[float, float], Ts: float = 0.01, decay: float = 0.0) -> Any:
    """Return a source whose axes have these static gains [m/V] and poles [1/s]."""
    boxes = [SimpleNamespace(nominal=np.array([gain, pole, 0.0])) for gain, pole in axes]
    return SimpleNamespace(axes=boxes, sample_time=Ts, weights=np.array([[1.0, 0.5], [0.0, 1.0]]), decay=decay)


def test_a_scale_is_that_of_the_slowest_and_least_of_all_plants() -> None:
    """What is known of a robot without ranges of its outputs is what its plants do; for the neck all is 1."""
    assert Scale.of(Robot.preset()) == Scale(robot=Robot.preset())
    assert (Scale().time, Scale().size, Scale().load, Scale().noise, Scale().gain) == (
        1.0,
        1.0,
        1.0,
        1.0,
        pytest.approx(1.0),
    )
    one, two = source_with((0.02, 5.0), (0.03, 4.0)), source_with((0.05, 9.0), (0.04, 8.0))
    found = Scale.of(CART, [one, two])
    assert found == Scale.of(CART, [two, one])
    assert found.known
    assert not Scale.of(CART).known
    # Seconds by the slowest pole, or by the sample time where that is longer.
    assert Scale.of(CART, [one]).time == found.time
    assert Scale.of(CART, [two]).time == pytest.approx(found.time * 4.0 / 8.0)
    assert Scale.of(CART, [source_with((0.02, 5.0), (0.03, 4.0), Ts=0.5)]).time == pytest.approx(2.0 * found.time)
    # Or by what decays later than the slowest pole of one.
    assert Scale.of(CART, [source_with((0.02, 5.0), (0.03, 4.0), decay=0.5)]).time == pytest.approx(2.0 * found.time)
    assert Scale.of(CART, [source_with((0.02, 5.0), (0.03, 4.0), decay=0.2)]).time == found.time
    # Inputs by the least that the motors add up to: half the ranges of 2 and 4 V, weighted: 4 and 4; outputs by the
    # least of gain times that.
    size = Scale.of(CART, [source_with((0.02, 5.0), (0.01, 4.0))]).size
    assert size == pytest.approx(0.5 * Scale.of(CART, [one]).size)
    assert found.size == pytest.approx(Scale.of(CART, [one]).size)
    assert Scale.of(CART, [source_with((-0.02, 5.0), (0.03, 4.0))]).size == pytest.approx(found.size)
    assert found.load == Scale.of(CART, [two]).load
    halved = replace(CART, motors=replace(CART.motors, setpoint_min=(-1.0, -1.0), setpoint_max=(1.0, 3.0)))
    assert Scale.of(halved, [one]).load == pytest.approx(0.5 * found.load)
    assert Scale.of(halved, [one]).size == pytest.approx(0.5 * found.size)
    # A range that is stated and narrower goes first.
    narrow = replace(CART, outputs=replace(CART.outputs, min=(-0.1, -0.1), max=(0.1, 0.1)))
    wide = replace(CART, outputs=replace(CART.outputs, min=(-1e6, -1e6), max=(1e6, 1e6)))
    assert Scale.of(narrow, [one]).size < found.size == pytest.approx(Scale.of(wide, [one]).size)
    loud = replace(CART, noise_std=0.3)
    assert Scale.of(loud, [one]).noise == pytest.approx(0.3 / 0.05)
    assert found.noise == pytest.approx(found.size, rel=1e-11)


@pytest.mark.parametrize("reach", [1.0, 0.3, 0.0])
def test_what_the_recordings_exclude_goes_towards_the_best_sample_up_to_their_border(
    reach: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Plants on lines from the best sample: those beyond `reach` end within a thousandth of the way before it."""
    best, other = np.array([1.0, 5.0, 0.1]), np.array([1.2, 6.0, 0.1])
    way = np.array([1.0, -2.0, 0.5])
    monkeypatch.setattr(
        _plants, "_excess", lambda rows, *_: np.abs((rows - best) @ way) / (way @ way) / max(reach, 1e-9)
    )
    box: Any = SimpleNamespace(measured=object(), nominal=other, samples=np.array([other + way, best]))
    rows = best + np.array([0.0, 0.2, 0.31, 1.0, 2.0])[:, None] * way
    found = (within_weight(rows, box, TS) - best) @ way / (way @ way)
    for share, length in zip(found, (0.0, 0.2, 0.31, 1.0, 2.0), strict=True):
        if length <= reach:
            assert share == pytest.approx(length)
        else:
            assert reach - length * 2.0**-10 - 1e-9 <= share <= reach + 1e-9
    # Where even the best is excluded the order is too low, and all stays as it is.
    monkeypatch.setattr(_plants, "_excess", lambda rows, *_: np.full(len(rows), 1.0 + 1e-9))
    assert within_weight(rows, box, TS) is rows
    monkeypatch.setattr(_plants, "_excess", lambda rows, *_: np.full(len(rows), 1.0))
    np.testing.assert_allclose(within_weight(rows, box, TS), rows)
    assert within_weight(rows, SimpleNamespace(measured=None), TS) is rows  # pyright: ignore[reportArgumentType]


def test_axes_of_a_model_have_one_sample_time_to_a_billionth() -> None:
    a, b = (control.TransferFunction([0.1], [1.0, -0.9], TS * factor) for factor in (1.0, 1.0 + 3e-9))
    for axes in ((a, b), (b, a)):
        with pytest.raises(SettingsError, match="m: pitch and roll have different sample times"):
            source_of_model(LinearNeck(*axes), "m", SPREAD)
    unstable = control.TransferFunction([0.1], [1.0, -1.1], TS)
    with pytest.raises(SettingsError, match=r"^m: .*not stable"):
        source_of_model(LinearNeck(a, unstable), "m", SPREAD)
    with pytest.raises(SettingsError, match="m: roll has a static gain of 0"):
        source_of_model(LinearNeck(a, control.TransferFunction([0.1, -0.1], [1.0, -1.5, 0.56], TS)), "m", SPREAD)


def crossed(row: int, gain: Any) -> Any:
    """Return a model whose axis `row` follows the other axis's input by `gain`, a static gain or a system."""
    systems, names = linear_neck(), ("pitch", "roll")
    other = gain if isinstance(gain, control.TransferFunction) else control.TransferFunction([gain], [1.0], TS)

    def tf(output: str, *, input: str | None = None) -> Any:
        own = {"pitch": "theta_i", "roll": "phi_i"}[output]
        away = other if names.index(output) == row else control.TransferFunction([0.0], [1.0], TS)
        return systems.tf(output) if input in (None, own) else away

    return SimpleNamespace(tf=tf)


@pytest.mark.parametrize("row", [0, 1])
def test_a_cross_gain_that_is_not_known_is_refused_and_one_that_is_known_counts(row: int) -> None:
    """Neither NaN nor infinity is no gain; a model of single axes alone has none."""
    own, towards = linear_neck().tf("pitch").dcgain(), ("phi_i to pitch", "theta_i to roll")[row]
    whole = family()
    for value in (math.nan, math.inf, -math.inf):
        gains = whole.cross.copy()
        gains[row, 1 - row] = value
        with pytest.raises(SettingsError, match=rf"^f: the gain from {towards} is not known \({value:g} of .*record"):
            source_of_family(replace(whole, cross=gains), "f")
        with pytest.raises(SettingsError, match=rf"^m: the gain from {towards} is not known \({value:g} of .*record"):
            source_of_model(crossed(row, value), "m", SPREAD)
    with pytest.raises(SettingsError, match=f"the gain from {towards} is not known"):
        source_of_model(crossed(row, control.TransferFunction([0.1], [1.0, -1.0], TS)), "m", SPREAD)
    for share, told in ((0.3, 0.3), (-0.3, -0.3), (2e-6, 2e-6), (-5e-7, 0.0)):
        expected = np.where(np.arange(2) == row, told, 0.0)
        np.testing.assert_allclose(source_of_model(crossed(row, share * own), "m", SPREAD).cross, expected, rtol=1e-9)
    assert source_of_model(linear_neck(), "m", SPREAD).cross.tolist() == [0.0, 0.0]

    def broken(output: str, *, input: str | None = None) -> Any:
        if input is not None:
            raise SettingsError("no such input")
        return linear_neck().tf(output)

    # What goes wrong in a model is told, and is no model of single axes.
    with pytest.raises(SettingsError, match="no such input"):
        source_of_model(SimpleNamespace(tf=broken), "m", SPREAD)


def test_a_file_of_requirements_is_a_path_and_its_errors_name_it(tmp_path: Path) -> None:
    path = tmp_path / "r.toml"
    for wrong in (3, [path], {"a": 1}):
        with pytest.raises(SettingsError, match="requirements are a file or a table; got a"):
            read_requirements(wrong)  # pyright: ignore[reportArgumentType]
    for text, error, message in (
        ("version = 1\n[sim]\nnecks = -1\n", SettingsError, "necks"), ("version = 2\n", FileFormatError, "must be 1"),
        ("[sim]\n", FileFormatError, "got None"), ("version = \n", FileFormatError, "is not valid TOML"),
        ("version = 1\nreserve = 3\n", SettingsError, "`reserve` must be a table"),
        ("version = 1\nrequire = 3\n", SettingsError, "`require` must be a table"),
    ):  # fmt: skip
        path.write_text(text)
        with pytest.raises(error, match=rf"r\.toml: .*{message}"):
            read_requirements(path)
    with pytest.raises(FileFormatError, match=r"none\.toml: "):
        read_requirements(tmp_path / "none.toml")
    with pytest.raises(SettingsError, match="`require` must be a table"):
        expand_metrics({"require": 3, "overshoot_pct": 5.0}, Robot.preset(), stepping=True)
    with pytest.raises(SettingsError, match=r"unknown requirement `overshot_pct`; .*overshoot_pct"):
        expand_metrics({"overshot_pct": 5.0}, Robot.preset(), stepping=True)


def test_steps_are_made_around_the_rest_of_a_robot_or_the_middle_of_its_ranges() -> None:
    def robot(**more: Any) -> Robot:
        tables = {
            "name": "cart", "directions": {"kind": "matrix", "matrix": [[1.0, 0.5], [0.0, 1.0]]},
            "motors": {"names": ["a", "b"], "unit": "kPa", **more.get("motors", {})},
            "outputs": {"names": ["x", "y"], "unit": "mm", **more.get("outputs", {})},
        }  # fmt: skip
        return Robot.from_dict(tables)

    block: Any = SimpleNamespace(parameters=())
    assert middle_of(robot()).tolist() == [0.0, 0.0]
    ends = {"min": [-10.0, 4.0], "max": [30.0, 8.0]}
    assert middle_of(robot(outputs=ends)) == pytest.approx([0.01, 0.006])
    assert middle_of(robot(outputs=ends | {"rest": [1.0, 5.0]})) == pytest.approx([0.001, 0.005])
    assert middle_motors(robot(), block).tolist() == [0.0, 0.0]
    ends = {"setpoint_min": [0.0, 10.0], "setpoint_max": [80.0, 40.0]}
    assert middle_motors(robot(motors=ends), block) == pytest.approx([40e3, 25e3])
    assert middle_motors(robot(motors=ends | {"rest": [3.0, 12.0]}), block) == pytest.approx([3e3, 12e3])


@pytest.mark.parametrize("cores", [1, 2, 3, 9])
def test_each_plant_is_stepped_once_with_the_channels_of_its_controller(
    cores: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A channel that a controller lacks has no place; one that looks ahead sees the step from the start."""
    plants = all_plants([source_of_family(family(), "f")], 24, 0).take(range(7))
    seen: list[Any] = []
    monkeypatch.setattr(_steps, "core_count", lambda: cores)
    monkeypatch.setattr(_steps, "load_functions", lambda _: SimpleNamespace(sweep_run=lambda *args: seen.append(args)))
    inputs = [
        "roll_reference",
        "pitch_reference",
        "pitch_reference_ahead",
        "pitch",
        "roll",
        "enabled",
        "motor_position_2",
    ]
    outputs = ["motor_setpoint_3", "motor_setpoint_1", "motor_setpoint_2"]
    block: Any = SimpleNamespace(
        runtime="r", arrays=(), initial_state=lambda: SimpleNamespace(parameters=np.zeros(1)),
        inputs=[SimpleNamespace(name=name, start=0.5 + k) for k, name in enumerate(inputs)],
        outputs=[SimpleNamespace(name=name) for name in outputs],
    )  # fmt: skip
    signals = np.arange(28.0).reshape(4, 7) + 100.0
    y, P = _steps._run(plants, block, signals, np.eye(3), Robot.preset())
    assert (y.shape, P.shape) == ((7, 4, 2), (7, 4, 3))
    first, *rest = seen
    assert first[5].shape[0] == 1
    # Threads take them in any order.
    stepped = sorted(str(row) for args in rest for row in args[5].tolist())
    assert stepped == sorted(map(str, plants.numerator.tolist()))
    assert sum(len(args[-1]) for args in rest) == sum(len(args[8]) for args in rest) == 7
    assert len(rest) == min(cores, 7)
    start, places, outputs_at = first[2], first[3], first[4]
    assert start.tolist() == [0.5, 1.5, 100.0, 3.5, 4.5, 5.5, 6.5]
    # References, co-contraction, outputs, positions, healthy, enabled.
    assert places.tolist() == [1, 0, -1, 3, 4, -1, 6, -1, -1, 5]
    assert outputs_at.tolist() == [1, 2, 0, 3]
