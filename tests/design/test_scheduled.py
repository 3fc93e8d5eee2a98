"""Gain scheduling: the special cases it must equal, no bumps, and what it refuses."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softneck.core import DataError, FileFormatError, SettingsError, load, read_archive, write_archive
from softneck.design import LinearController, ScheduledSettings, VaryingController
from softneck.design.linear._assembly import ReferenceFilter, assemble
from softneck.design.linear._tuning import Gains
from softneck.design.varying._scheduled import following_axis
from softneck.estimation import LinearNeck, axis_plant
from softneck.identification import Family, FamilySettings, Lpv
from softneck.loop import BlockPart, Loop, StepReference, metrics, run_loop
from softneck.runtime import load_runtime

from ..data import neck_recording
from .test_pi import DelayedNeck

TS = 0.02
DEG = math.radians(1.0)


def neck(gain_deg: float = 5.2, pole: float = 5.3, *, delay: int = 4, sample_time: float = TS) -> LinearNeck:
    a = math.exp(-pole * sample_time)
    axis = control.TransferFunction([gain_deg * DEG * (1.0 - a)], [1.0, -a, *([0.0] * delay)], sample_time)
    return LinearNeck(pitch=axis, roll=axis)


def scheduled(models: list[LinearNeck], inclinations: list[float], **settings: Any) -> VaryingController:
    chosen = replace(ScheduledSettings(inclinations=tuple(angle * DEG for angle in inclinations)), **settings)
    return chosen.design(models)


@cache
def family() -> Family:
    return FamilySettings(window=6.0).fit(neck_recording(1500))


def inputs(rows: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([0.3 * rng.standard_normal((rows, 8)), rng.random((rows, 2)) > 0.1]).astype(float)


def test_equal_operating_points_make_the_linear_controller() -> None:
    controller = scheduled([neck(), neck()], [0.0, 20.0])
    first = controller.design["gains"][0]
    axes = [following_axis(Gains(**gains), axis_plant(neck(), "pitch"), 4, 3.0) for gains in first]
    linear = LinearController(
        kind="pi", sample_time=TS, order="sequential", design={}, limits=ScheduledSettings().limits(),
        arrays=assemble(
            (axes[0], axes[1]), filters=(ReferenceFilter(0.06),) * 3, constants=np.array([TS]),
            redefinition=ScheduledSettings().neck_redefinition(),
        ),
    )  # fmt: skip
    U = inputs(300)
    ours = controller.block().run(controller.initial_state(), U)[1]
    same = linear.block().run(linear.initial_state(), U)[1]
    # Sums of (1 - part) M and part M round, and so do alignments corrected to be exact.
    np.testing.assert_allclose(ours, same, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("which", [0, 1, 2])
def test_at_an_operating_point_it_is_the_controller_of_that_point(which: int) -> None:
    models, inclinations = [neck(6.0), neck(5.0), neck(4.0, 7.0)], [4.0, 14.0, 24.0]
    controller = scheduled(models, inclinations)
    alone = scheduled([models[which]] * 2, [0.0, 40.0])
    U = inputs(200)
    U[:, 3], U[:, 4] = inclinations[which] * DEG, 0.0
    runs = [item.block().run(item.initial_state(), U)[1] for item in (controller, alone)]
    np.testing.assert_allclose(runs[0], runs[1], atol=1e-9)


def test_compiled_and_plain_agree() -> None:
    block = scheduled([neck(6.0), neck(4.0)], [2.0, 20.0]).block()
    U = inputs(300)
    compiled = block.run(block.initial_state(), U)[1]
    state, Y = block.initial_state(), np.zeros((300, 3))
    load_runtime(block.runtime, compiled=False).run_steps(block.arrays, state.parameters, state.values.copy(), U, Y)
    # Products of small matrices may be summed in another order.
    np.testing.assert_allclose(Y, compiled, atol=1e-11)


CONTROLLER = scheduled([neck(6.0), neck(4.0, 8.0)], [3.0, 18.0], lead_limit=12.0)
ANGLES = st.floats(-0.6, 0.6)
MOTORS = st.tuples(*[st.floats(-5.0, 5.0)] * 3)


@given(motors=MOTORS, pitch=ANGLES, roll=ANGLES)
def test_it_starts_without_a_bump_at_any_inclination(
    motors: tuple[float, float, float], pitch: float, roll: float
) -> None:
    block = CONTROLLER.block()
    state = block.initial_state()
    u = np.array([pitch, roll, float(np.mean(motors)), pitch, roll, *motors, 1.0, 1.0])
    for _ in range(5):
        state, P = block.step(state, u)
        # The correction of the alignment is exact but for rounding of values up to 10.
        np.testing.assert_allclose(P, motors, atol=1e-9)


@given(pitch=ANGLES, motors=MOTORS)
def test_while_stopped_it_holds_and_goes_on_where_the_neck_was_moved_to(
    pitch: float, motors: tuple[float, float, float]
) -> None:
    block = CONTROLLER.block()
    state, before = block.step(block.initial_state(), np.array([0.0, 0.0, 0.0, 0.0, 0.0, *motors, 1.0, 1.0]))
    for k in range(10):
        state, P = block.step(state, np.array([0.3, 0.1, 1.0, k * pitch / 9.0, 0.0, *motors, 1.0, 0.0]))
        np.testing.assert_array_equal(P, before)
    u = np.array([pitch, 0.0, float(np.mean(before)), pitch, 0.0, *before, 1.0, 1.0])
    np.testing.assert_allclose(block.step(state, u)[1], before, atol=1e-9)


def test_gains_that_change_on_the_way_do_not_jump() -> None:
    """The inclination is lagged, so what a jump of it adds to a set-point comes in small steps."""
    block = CONTROLLER.block()
    rest = np.array([0.1, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0])
    state = block.run(block.initial_state(), np.tile(rest, (50, 1)))[0]
    values = state.values.copy()
    moved = replace(state, values=values)
    # As if the neck had been at 18 deg until now: only the schedule differs.
    moved.values[-2] = 18.0 * DEG
    same, other = (block.step(item, rest)[1] for item in (state, moved))
    # The feedforward differs by 0.1 rad (1/4 - 1/6 per deg) = 0.48 rad if all of it came at once; 1e-9: none of it may
    # come where the reference is zero.
    assert np.abs(other - same).max() < 0.5
    zero = rest * np.array([0.0, 1.0, 1.0, 0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    state = block.run(block.initial_state(), np.tile(zero, (50, 1)))[0]
    moved = replace(state, values=state.values.copy())
    moved.values[-2] = 18.0 * DEG
    np.testing.assert_allclose(block.step(moved, zero)[1], block.step(state, zero)[1], atol=1e-9)


def test_a_neck_as_modelled_follows_the_filtered_reference_without_overshoot() -> None:
    controller = scheduled([neck(), neck()], [0.0, 25.0], lead_limit=12.0)
    plant = DelayedNeck(gain=5.2 * DEG / (math.radians(27.69) / 5.293), noise_deg=0.0)
    step = StepReference(pitch=10.0 * DEG, at=0.5)
    found = metrics(run_loop(Loop(plant=plant, controller=BlockPart(controller.block()), reference=step, duration=5.0)))
    overshoot = found["pitch"]["overshoot_pct"]
    assert overshoot is not None
    # The plant's pole is 5.293, not 5.3, and the slew limit holds the first two samples back.
    assert overshoot < 0.5


def test_pause_and_resume_equals_one_run() -> None:
    block = CONTROLLER.block()
    U = inputs(60)
    whole = block.run(block.initial_state(), U)[1]
    state, first = block.run(block.initial_state(), U[:25])
    np.testing.assert_array_equal(np.vstack([first, block.run(state, U[25:])[1]]), whole)


@pytest.mark.slow
def test_a_family_gives_its_interpolation_or_its_operating_points() -> None:
    lpv = Lpv(
        knots=np.array([2.0, 20.0]) * DEG, gains=np.array([[6.0, 4.0], [5.0, 5.0]]) * DEG,
        poles=np.array([[5.0, 8.0], [6.0, 6.0]]), delays=np.array([3.0, 4.0]),
    )  # fmt: skip
    by_lpv = ScheduledSettings().design(replace(family(), lpv=lpv))
    np.testing.assert_allclose(by_lpv.design["inclinations_deg"], [2.0, 20.0])
    by_points = ScheduledSettings().design(family())
    assert len(by_points.design["inclinations_deg"]) >= 2
    assert "largest Ms of all loops" in by_points.summary()


def test_every_loop_between_two_points_keeps_what_is_printed() -> None:
    found = CONTROLLER.design
    low, high = found["gains"]
    w = np.geomspace(0.1, math.pi / TS, 4000)
    z = np.exp(1j * w * TS)
    for part in np.linspace(0.0, 1.0, 9):
        K = (1.0 - part) * low[0]["gain"] + part * high[0]["gain"]
        rate = (1.0 - part) * low[0]["gain"] / low[0]["integral_time"]
        rate += part * high[0]["gain"] / high[0]["integral_time"]
        for gain, pole in ((6.0, 5.3), (4.0, 8.0)):
            a = math.exp(-pole * TS)
            L = (K + rate * TS / (z - 1.0)) * gain * DEG * (1.0 - a) / (z - a) * z**-4
            # It is judged at five places, and here at nine.
            assert np.abs(1.0 / (1.0 + L)).max() <= found["largest_ms"] * 1.01


def test_a_saved_controller_is_the_same_and_a_damaged_one_is_refused(tmp_path: Path) -> None:
    CONTROLLER.save(tmp_path / "s.npz")
    again = load(tmp_path / "s.npz", role="controller")
    assert again.summary() == CONTROLLER.summary()
    U = inputs(40)
    first, second = (c.block().run(c.initial_state(), U)[1] for c in (CONTROLLER, again))
    np.testing.assert_array_equal(first, second)
    header, arrays = read_archive(tmp_path / "s.npz")
    header = {key: value for key, value in header.items() if not key.startswith("format")}
    write_archive(tmp_path / "bad.npz", header, {**arrays, "knots": np.zeros(3)})
    with pytest.raises(FileFormatError, match=r"its array `A` has shape \(.*\) is needed"):
        load(tmp_path / "bad.npz")


@pytest.mark.parametrize(
    ("models", "inclinations", "message"),
    [
        ([neck()], [0.0], r"at least two models with one of `inclinations` each; got 1 model\(s\)"),
        ([neck(), neck()], [0.0], r"got 2 model\(s\) and 1 inclination"),
        ([neck(), neck()], [5.0, 5.5], "at least 1 deg apart; got 5 and 5.5 deg"),
        ([neck(), neck(-5.0)], [0.0, 20.0], "between two operating points, is not stable"),
    ],
    ids=["one", "unnamed", "same", "reversed"],
)
def test_what_cannot_be_scheduled_is_refused(models: list[LinearNeck], inclinations: list[float], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        scheduled(models, inclinations)


def test_models_of_different_sample_times_are_refused() -> None:
    with pytest.raises(DataError, match=r"different sample times cannot be scheduled together: 0\.02 s and 0\.01 s"):
        scheduled([neck(), neck(sample_time=0.01)], [0.0, 20.0])


@pytest.mark.slow
def test_a_family_of_one_inclination_is_refused() -> None:
    with pytest.raises(SettingsError, match="where scheduling needs 2: make it with `--set lpv_knots=3`"):
        ScheduledSettings().design(replace(family(), settings={"inclination_step": 3.0}))
    with pytest.raises(SettingsError, match="`inclinations` are for several models"):
        ScheduledSettings(inclinations=(0.0, 0.3)).design(family())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"schedule_time": -1.0}, "`schedule_time` must be between"),
        ({"inclinations": (15.0, 20.0)}, r"`inclinations` must be between 0 and 1\.5 \[rad\]; got 15"),
        ({"leak_time": 0.0}, "`leak_time` must be between"),
        ({"slew_limit": 0.0}, "`slew_limit` must be positive"),
        ({"order": "other"}, "`order` must be one of"),
        ({"least_cocontraction": 6.0}, "`least_cocontraction` must be below `position_limit`"),
    ],
)
def test_wrong_settings_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        ScheduledSettings(**settings).limits()
