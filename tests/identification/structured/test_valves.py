"""Chambers that fill and vent at different speeds: kind `play` finds them, and takes them for nothing else."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from fmpy import simulate_fmu

from softneck import load
from softneck.fmu import build_compiled_fmu
from softneck.identification import Model, Play
from softneck.identification.structured import _play
from softneck.identification.structured._play_draws import PlayDraws
from softneck.robot import Robot
from softneck.signals import Recording

TS = 0.01
ROBOT = Robot.from_dict(
    {
        "name": "muscle",
        "motors": {"names": ["valve"], "unit": "kPa"},
        "outputs": {"names": ["height"], "unit": "mm"},
        "directions": {"kind": "identified"},
        "sample_time_s": TS,
    }
)


def pressure(u: np.ndarray, filling: float, venting: float) -> np.ndarray:
    """The chamber's pressure by the exact step of its lag, from rest at the first set-point."""
    p = np.full(u.size, u[0])
    for k in range(u.size - 1):
        time = filling if u[k] > p[k] else venting
        p[k + 1] = u[k] + (p[k] - u[k]) * np.exp(-TS / time)
    return p


@cache
def recorded(filling: float, venting: float, seed: int = 0, rows: int = 3000) -> Recording:
    """Two equal lags of 50 ms behind the chamber, a bent gain, and a sensor of a thousandth of the range."""
    rng = np.random.default_rng(seed)
    u = 1e3 * np.repeat(rng.uniform(5.0, 95.0, rows // 30 + 1), rng.integers(20, 60, rows // 30 + 1))[:rows]
    y = pressure(u, filling, venting)
    for _ in range(2):
        x, a = y.copy(), np.exp(-TS / 0.05)
        for k in range(rows - 1):
            y[k + 1] = a * y[k] + (1.0 - a) * x[k]
    y = 3e-7 * y + 1e-12 * y**2 + 4e-5 * rng.standard_normal(rows)
    return Recording(TS * np.arange(rows), TS, {"valve_setpoint": u, "height": y}, robot=ROBOT)


@cache
def fitted() -> Model:
    return Play().fit(recorded(0.05, 0.15))


def error(model: Model, recording: Recording) -> float:
    """The rms error of a simulation, in ranges of the output."""
    y = recording.outputs[:, 0]
    return float(np.std(model.simulate(recording)[25:, 0] - y[25:]) / np.ptp(y))


@pytest.mark.parametrize(("filling", "venting"), [(0.05, 0.15), (0.15, 0.05)])
def test_valves_are_found_and_help_on_another_recording(
    filling: float, venting: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, other = Play().fit(recorded(filling, venting)), recorded(filling, venting, seed=5)
    found = model.findings
    # Filters of one speed stand for the lags behind, and take a part of the shorter time: the order is certain.
    assert (found["venting_s"] > 1.5 * found["filling_s"]) == (venting > filling)
    assert found["venting_s"] > 1.5 * found["filling_s"] or found["filling_s"] > 1.5 * found["venting_s"]
    monkeypatch.setattr(_play, "_VALVE_MISFIT", 0.0)
    without = Play().fit(recorded(filling, venting))
    assert without.arrays["load"].size == 4
    # Both lags behind are in the filters already: what is left is the difference of the speeds.
    assert error(without, other) > 4.0 * error(model, other)


def test_a_chamber_of_one_speed_has_no_valves() -> None:
    model = Play().fit(recorded(0.1, 0.1))
    assert "filling_s" not in model.findings
    assert model.arrays["load"].size == 4


def test_logged_pressures_need_no_valves() -> None:
    whole = recorded(0.05, 0.15)
    logged = whole.with_channels(valve_position=pressure(whole.set_points[:, 0], 0.05, 0.15))
    assert Play().fit(logged).arrays["load"].size == 4


def test_the_motor_of_the_model_is_the_chamber_and_its_file_says_the_same(tmp_path: Path) -> None:
    recording = recorded(0.05, 0.15)
    free = fitted().simulate(recording, warm_up=1)
    p = pressure(recording.set_points[:, 0], *(fitted().findings[name] for name in ("filling_s", "venting_s")))
    # The motor of the model is the chamber: equal to rounding of 1e5 Pa but for the first rows, from its own rest.
    np.testing.assert_allclose(free[300:, 1], p[300:], rtol=0, atol=1e-4)
    fitted().save(tmp_path / "m.npz")
    np.testing.assert_array_equal(load(tmp_path / "m.npz").simulate(recording, warm_up=1), free)


def test_the_compiled_fmu_is_the_model(tmp_path: Path) -> None:
    block = fitted().block()
    build_compiled_fmu(block, tmp_path / "m.fmu")
    u = recorded(0.05, 0.15).set_points[:400, 0]
    times = TS * np.arange(u.size)
    given = np.array(list(zip(times, u, strict=True)), dtype=[("time", "f8"), ("valve_setpoint", "f8")])
    found = simulate_fmu(
        tmp_path / "m.fmu", input=given, stop_time=times[-1], output_interval=TS, step_size=TS, output=["height"]
    )
    U = np.full((u.size - 1, len(block.inputs)), np.nan)
    U[:, 0] = u[:-1]
    expected = block.run(block.initial_state(), U)[1][:, 0]
    # C and numba round alike but for contraction of a few operations.
    np.testing.assert_allclose(found["height"][1:], expected, rtol=0, atol=1e-12)


def test_the_casadi_function_is_the_step() -> None:
    block, f = fitted().block(), fitted().casadi()
    state, U = block.initial_state(), np.full(len(block.inputs), np.nan)
    for value in np.repeat([3e4, 8e4, 2e4], 7):  # no lag has settled: it fills, fills on, then vents
        U[0] = value
        x_next, y = f(state.values, value)
        state, outputs = block.step(state, U)
        # The order of sums differs: rounding of 1e5 Pa, and of the generator's integers, of which none is drawn.
        np.testing.assert_allclose(np.array(x_next)[:, 0], state.values, rtol=1e-12, atol=1e-9)
        np.testing.assert_allclose(np.array(y)[:, 0], outputs, rtol=1e-12, atol=1e-9)


def test_draws_keep_the_valves() -> None:
    made = PlayDraws.fit(recorded(0.05, 0.15))
    np.testing.assert_array_equal(made.model.arrays["load"], fitted().arrays["load"])
    again = made.arrays(np.ones(int(made.groups.max()) + 1), 0.0)
    np.testing.assert_allclose(again["weights"], made.model.arrays["weights"], rtol=1e-6, atol=1e-12)
