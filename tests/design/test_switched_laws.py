"""Switching by the estimated payload: what it must equal, how often it may switch, no bumps, and what it refuses."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softneck.core import FileFormatError, SettingsError, load, read_archive, write_archive
from softneck.cosim.parts._free_run import drive_fmu
from softneck.design import LinearController, VaryingController
from softneck.design.linear._assembly import ReferenceFilter, assemble
from softneck.design.linear._tuning import Gains
from softneck.design.varying._scheduled import following_axis
from softneck.design.varying._switched import SwitchedSettings, _closed, _sensitivity
from softneck.design.varying._switched_runtime import SwitchedArrays, SwitchedState
from softneck.estimation import axis_plant
from softneck.fmu import build_fmu
from softneck.runtime import Block, load_runtime

from .test_scheduled import TS, neck

LOADS = (0.0, 0.5, 1.0)
MODELS = [neck(6.0), neck(5.0, 4.5), neck(4.0, 4.0)]
# Below what the design asks for nothing is switched; 0.2 s makes many switches in a short test.
DWELL = 0.2


@cache
def switched(**changes: Any) -> VaryingController:
    chosen = {"payloads": LOADS, "dwell_time": DWELL, "lead_limit": 12.0} | changes
    return SwitchedSettings(**chosen).design(MODELS)


def inputs(rows: int, payload: Any = 0.0, changed: Any = 0.0, seed: int = 0) -> np.ndarray:
    """References, angles and motors at random, healthy and enabled throughout, then payload and `changed`."""
    U = np.zeros((rows, 12))
    U[:, :8] = 0.1 * np.random.default_rng(seed).standard_normal((rows, 8))
    U[:, 8:10], U[:, 10], U[:, 11] = 1.0, payload, changed
    return U


def states(block: Block, U: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return the parts of the state after each row, and the set-points."""
    runtime, state = load_runtime(block.runtime), block.initial_state()
    values, out, kept, told = state.values.copy(), np.zeros(3), [], []
    for row in U:
        runtime.step(block.arrays, state.parameters, values, row.copy(), out)
        kept.append(values.copy())
        told.append(out.copy())
    parts = SwitchedState.parts(SwitchedArrays(block.arrays))
    return {name: np.array(kept)[:, part] for name, part in parts.items()}, np.array(told)


@pytest.mark.parametrize("which", [0, 1, 2])
def test_at_a_constant_payload_it_is_the_plain_pi_of_that_payload(which: int) -> None:
    controller = switched()
    # What is followed is no slower than small moves are, as of `scheduled`.
    plant = axis_plant(MODELS[which], "pitch").delayed(0.08).faster(5.293)
    axes = [following_axis(Gains(**axis), plant, 4, 3.0) for axis in controller.design["gains"][which]]
    chosen = SwitchedSettings(payloads=LOADS, lead_limit=12.0)
    linear = LinearController(
        kind="pi", sample_time=TS, order="sequential", design={}, limits=chosen.limits(),
        arrays=assemble(
            (axes[0], axes[1]), filters=(ReferenceFilter(0.06),) * 3, constants=np.array([TS]),
            redefinition=chosen.neck_redefinition(),
        ),
    )  # fmt: skip
    U = inputs(300, LOADS[which])
    U[:, 8:10] = np.random.default_rng(1).random((300, 2)) > 0.1
    ours = controller.block().run(controller.initial_state(), U)[1]
    same = linear.block().run(linear.initial_state(), U[:, :10])[1]
    # The alignment after a stop is corrected to be exact, once: rounding of set-points up to 10 rad.
    np.testing.assert_allclose(ours, same, atol=1e-9)


PAYLOADS = st.lists(
    st.tuples(st.sampled_from([*LOADS, 0.26, 0.7, -3.0, 9.0, math.nan]), st.integers(1, 25)), min_size=1, max_size=12
)


@settings(max_examples=40)
@given(PAYLOADS)
def test_between_two_switches_there_is_the_dwell_time_whatever_the_payload_says(parts: list[tuple[float, int]]) -> None:
    controller = switched()
    payload = np.concatenate([np.full(rows, kg) for kg, rows in parts])
    chosen = states(controller.block(), inputs(len(payload), payload))[0]["chosen"][:, 0]
    at = np.flatnonzero(np.diff(chosen))
    assert controller.design["dwell_s"] >= max(DWELL, controller.design["dwell_needed_s"]) - 1e-12
    assert (np.diff(at) >= round(controller.design["dwell_s"] / TS)).all()
    assert set(chosen) <= {0.0, 1.0, 2.0}


def test_an_estimate_near_the_middle_does_not_switch_and_one_past_the_margin_does() -> None:
    # The middle is 0.25 kg, the margin a tenth of the 0.5 kg between both.
    rows, first = 40, lambda kg: states(switched().block(), inputs(40, np.r_[0.0, np.full(39, kg)]))[0]["chosen"]
    assert not first(0.299).any()
    assert first(0.301)[1:].all()
    # Lost, it stays where it was.
    kept = states(switched().block(), inputs(rows, np.r_[np.full(5, 0.5), np.full(35, math.nan)]))[0]["chosen"]
    assert (kept == 1.0).all()


@settings(max_examples=30)
@given(row=st.integers(1, 40), here=st.sampled_from(LOADS), there=st.sampled_from(LOADS), seed=st.integers(0, 99))
def test_a_switch_moves_no_set_point(row: int, here: float, there: float, seed: int) -> None:
    """In the sample of the switch the set-points are those without it, whatever the loop was doing."""
    payload = np.full(row + 1, here)
    payload[row] = there
    parts, moved = states(switched().block(), inputs(row + 1, payload, seed=seed))
    same = states(switched().block(), inputs(row + 1, here, seed=seed))[1]
    assert (parts["chosen"][row] != parts["chosen"][row - 1]) == (here != there)
    # Sums of another order: rounding of set-points up to 10 rad.
    np.testing.assert_allclose(moved, same, atol=1e-9)


@pytest.mark.parametrize("flag", [8, 9], ids=["healthy", "enabled"])
def test_while_it_does_not_act_nothing_moves_and_no_bump_follows(flag: int) -> None:
    payload = np.repeat(LOADS, 20)
    U = inputs(60, payload)
    U[20:50, flag] = 0.0
    parts, P = states(switched().block(), U)
    np.testing.assert_array_equal(P[20:50], np.tile(P[19], (30, 1)))
    still = U.copy()
    # At rest where it was left: the first set-points are the held ones.
    still[50:, 3:5] = still[50:, :2] = 0.05
    still[20:50, 3:5] = 0.05
    still[50:, 2] = P[49].mean()
    np.testing.assert_allclose(states(switched().block(), still)[1][50], P[49], atol=1e-9)
    # It comes back as the one of the payload of now.
    assert parts["chosen"][49, 0] == 2.0


def test_a_changed_neck_is_led_slowly_and_no_otherwise() -> None:
    """`changed` under a step is, to the bit, no `changed` under a ramp of `slow_rate`."""
    controller = switched(slow_rate=0.5)
    U = inputs(120, changed=np.r_[np.zeros(30), np.ones(60), np.zeros(30)], seed=3)
    U[:, :2] = 0.0
    U[30:, :2] = [0.2, -0.1]
    ramp = U.copy()
    ramp[:, 11] = 0.0
    rows = np.arange(120)
    for axis, end in ((0, 0.2), (1, -0.1)):
        steps = np.zeros(120)
        for k in range(1, 120):
            steps[k] = steps[k - 1] + min(max((end if rows[k] >= 30 else 0.0) - steps[k - 1], -0.5 * TS), 0.5 * TS)
        ramp[:, axis] = steps
    slow, led = (controller.block().run(controller.initial_state(), item)[1] for item in (U, ramp))
    np.testing.assert_array_equal(slow, led)
    asked = states(controller.block(), U)[0]["asked"]
    # One rounding of the sum.
    assert np.abs(np.diff(asked[29:], axis=0)).max() <= 0.5 * TS * (1.0 + 1e-9)
    quick = controller.block().run(controller.initial_state(), np.where(np.arange(12) == 11, 0.0, U))[1]
    assert np.abs(quick - slow).max() > 0.1


def test_no_sequence_with_that_dwell_time_between_switches_drives_the_loop_off() -> None:
    """Independent of the proof: random orders shrink, at any dwell from the least on."""
    controller = switched(dwell_time=0.0)
    least, rng = round(controller.design["dwell_needed_s"] / TS), np.random.default_rng(1)
    pairs = [Gains(**axes[0]) for axes in controller.design["gains"]]
    for model in MODELS:
        plant = axis_plant(model, "pitch").delayed(0.08)
        loops = [_closed(gains, plant, 0) for gains in pairs]
        for _ in range(60):
            order, whole = rng.integers(0, 3, 12), np.eye(len(loops[0]))
            for here, there in zip(order, np.roll(order, -1), strict=True):
                reset = np.eye(len(whole))
                reset[0, 1] += pairs[there].gain - pairs[here].gain
                whole = reset @ np.linalg.matrix_power(loops[here], least + int(rng.integers(0, 8))) @ whole
            assert np.abs(np.linalg.eigvals(whole)).max() < 1.0


def test_gains_of_a_payload_keep_the_bound_at_the_next_ones_too() -> None:
    """Until the estimate is past the middle between two payloads and its margin, the neck may be at the next one."""
    controller = switched(max_sensitivity=1.4, small_move_pole=0.0)
    plants = [axis_plant(model, "pitch").delayed(0.08) for model in MODELS]
    for place, axes in enumerate(controller.design["gains"]):
        for plant in plants[max(place - 1, 0) : place + 2]:
            # Between frequencies of the design a peak is at most 0.2 % higher.
            assert _sensitivity(Gains(**axes[0]), plant, 0) < 1.4 * 1.002


def test_where_no_dwell_time_is_found_it_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    """As of a loop that takes longer to die out than is looked for."""
    assert "are shown to be enough" in switched().summary()
    monkeypatch.setattr("softneck.design.varying._switched._LONGEST_DWELL", 0.0)
    controller = SwitchedSettings(payloads=LOADS).design(MODELS)
    assert controller.design["dwell_needed_s"] is None
    assert "any sequence of them is not shown" in controller.summary()


def test_compiled_plain_and_paused_agree(tmp_path: Path) -> None:
    block = switched().block()
    U = inputs(120, np.repeat([0.0, 1.0, 0.5], 40), np.repeat([0.0, 1.0], 60))
    whole = block.run(block.initial_state(), U)[1]
    state, Y = block.initial_state(), np.zeros((120, 3))
    load_runtime(block.runtime, compiled=False).run_steps(block.arrays, state.parameters, state.values.copy(), U, Y)
    # Products of small matrices may be summed in another order.
    np.testing.assert_allclose(Y, whole, atol=1e-11)
    for cut in (25, 40, 41):
        state, first = block.run(block.initial_state(), U[:cut])
        np.testing.assert_array_equal(np.vstack([first, block.run(state, U[cut:])[1]]), whole)
    # As an FMU the same runtime steps: the same bits. A controller answers at once.
    build_fmu(block, tmp_path / "s.fmu")
    named = {port.name: U[:, i] for i, port in enumerate(block.inputs)}
    found = drive_fmu(tmp_path / "s.fmu", named, parameters={"use_motor_positions": 1.0})
    np.testing.assert_array_equal(found[:-1], whole[:-1])


def test_a_saved_one_is_the_same_and_a_damaged_one_is_refused(tmp_path: Path) -> None:
    switched().save(tmp_path / "s.npz")
    again = load(tmp_path / "s.npz", role="controller")
    assert again.summary() == switched().summary()
    U = inputs(60, np.repeat(LOADS, 20))
    first, second = (item.block().run(item.initial_state(), U)[1] for item in (switched(), again))
    np.testing.assert_array_equal(first, second)
    header, arrays = read_archive(tmp_path / "s.npz")
    header = {key: value for key, value in header.items() if not key.startswith("format")}
    write_archive(tmp_path / "bad.npz", header, {**arrays, "payloads": np.zeros(2)})
    with pytest.raises(FileFormatError, match=r"its array `.*` has shape \(.*\) is needed"):
        load(tmp_path / "bad.npz")


@pytest.mark.parametrize(
    ("models", "payloads", "message"),
    [
        ([neck()], (0.0,), r"at least two models or families, .*; got 1 and 1 payload"),
        ([neck(), neck()], (0.0,), r"got 2 and 1 payload"),
        ([neck(), neck()], (0.5, 0.5), "no two alike"),
        ([neck(), neck(sample_time=0.01)], (0.0, 1.0), "different sample times"),
        ([neck(), neck(), neck(40.0)], LOADS, "gains of 0 kg are not stable at 1 kg"),
    ],
    ids=["one", "unnamed", "same", "sampled otherwise", "far"],
)
def test_what_cannot_be_switched_is_refused(models: list[Any], payloads: tuple[float, ...], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        SwitchedSettings(payloads=payloads).design(models)


@pytest.mark.parametrize(
    "wrong", [{"payloads": (-1.0, 0.0)}, {"margin": 0.5}, {"slow_rate": 0.0}, {"dwell_time": -1.0}]
)
def test_wrong_settings_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(SettingsError, match=f"`{next(iter(wrong))}` must be between"):
        SwitchedSettings(**wrong)
