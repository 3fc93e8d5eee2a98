"""Angles that jump by a full turn: unwrapping undoes wrapping, and leaves everything else alone."""

from __future__ import annotations

import numpy as np
import pytest

from softneck.signals import Recording, assess_quality
from softneck.signals.recording._wraps import count_wraps, unwrap

TURN = 2.0 * np.pi


def walk(seed: int, step: float = 0.2) -> np.ndarray:
    """Return a random walk (400,) [rad] over several turns."""
    return np.cumsum(np.random.default_rng(seed).uniform(-step, 1.5 * step, 400))


@pytest.mark.parametrize("low", [0.0, -0.5 * TURN])
@pytest.mark.parametrize("seed", range(5))
def test_unwrapping_undoes_wrapping_up_to_whole_turns(seed: int, low: float) -> None:
    x = walk(seed)
    wrapped = (x - low) % TURN + low
    y, jumps = unwrap(wrapped, np.zeros(400), TURN)
    assert jumps == np.count_nonzero(np.abs(np.diff(wrapped)) > 0.5 * TURN) > 0
    # Rounding of sums of 400 steps: 400 eps, 1000x margin.
    np.testing.assert_allclose(np.diff(y), np.diff(x), atol=1e-10)
    assert unwrap(y, np.zeros(400), TURN)[1] == 0


def test_missed_samples_stay_missed_and_each_run_comes_near_the_first() -> None:
    # A slow walk about 0 in three runs; the sensor's edge is there.
    x = np.sin(np.linspace(0.0, 40.0, 400)) * 0.3
    x[50:53] = np.nan
    y, jumps = unwrap(x % TURN, np.repeat([0, 1, 2], [100, 150, 150]), TURN)
    assert jumps > 0
    np.testing.assert_array_equal(np.isnan(y), np.isnan(x))
    assert np.nanmax(np.abs(y - y[0] - (x - x[0]))) < 1e-10


@pytest.mark.parametrize("turn", [1.0, 360.0, 1e-3])
def test_a_turn_may_be_in_any_unit(turn: float) -> None:
    """What is a wrap in radians is one in turns, in degrees and in thousands of them."""
    factor, run = turn / TURN, np.repeat([0, 1], 200)
    for x in (walk(1) % TURN, 0.05 * np.arange(400.0) % TURN - 0.6 * TURN, np.sin(np.arange(400.0)) % TURN):
        y, jumps = unwrap(x, run, TURN)
        scaled, found = unwrap(factor * x, run, turn)
        assert found == jumps
        np.testing.assert_allclose(scaled, factor * y, atol=1e-9 * turn)


def sawtooth(rows: int = 200, period: int = 40, *, step: float = 1.0, low: float = 0.0) -> np.ndarray:
    """Return an angle in turns that rises evenly and falls back by `step` at the end of each period."""
    return low + step * (np.arange(rows) % period) / period


@pytest.mark.parametrize(
    ("x", "counted"),
    [
        # Fifty samples tell an ordinary step.
        (sawtooth(50), True), (sawtooth(49), False), (np.append(sawtooth(49), np.nan), False),
        # The edges of a turn, overrun by a thousandth at most.
        (sawtooth(low=0.0249), True), (sawtooth(low=0.0261), False), (sawtooth(low=-0.0009), True),
        (sawtooth(low=-0.0011), False), (sawtooth(low=-0.5009), True), (sawtooth(low=-0.5011), False),
        (sawtooth(low=-0.4741), True), (sawtooth(low=-0.4739), False),
        # Without its turn the step of a jump is at most a tenth of one, where others are short ...
        (sawtooth(period=100, step=0.92), True), (sawtooth(period=100, step=0.90), False),
        # ... or three times as long as those, and a quarter of a turn at most.
        (sawtooth(period=10, step=0.9), True), (sawtooth(period=10, step=0.84), True),
        (sawtooth(period=10, step=0.83), False), (sawtooth(period=5, step=0.95), True),
        (sawtooth(period=5, step=0.93), False),
        # As many as three of ten steps are jumps, and three of ten rows at least move.
        (sawtooth(301, period=4, step=1.0), True), (sawtooth(301, period=3, step=1.0), False),
        (np.repeat(sawtooth(100), 3), True), (np.repeat(sawtooth(100), 4), False),
    ],
)  # fmt: skip
def test_the_edges_of_what_a_wrap_is(x: np.ndarray, counted: bool) -> None:
    here = x[np.isfinite(x)]
    assert count_wraps(x, 1.0) == (np.count_nonzero(np.diff(here) < -0.5) if counted else 0)


@pytest.mark.parametrize(
    "x",
    [
        np.repeat([0.0, TURN, 0.0, TURN], 100),
        np.where(np.arange(400) % 100 == 50, 0.0, 0.6 * TURN + 0.01 * np.sin(np.arange(400.0))),
        3.0 * TURN * np.sin(np.arange(400.0)),
        0.05 * np.arange(400.0) % TURN - 0.6 * TURN,
        0.05 * np.arange(400.0) % TURN - 0.4 * TURN,
        np.full(400, np.nan),
        np.zeros(0),
    ],
    ids=[
        "held commands",
        "spikes to zero",
        "beyond a turn",
        "below half a turn",
        "above half a turn",
        "nothing",
        "no rows",
    ],
)
def test_other_jumps_are_left_alone(x: np.ndarray) -> None:
    assert count_wraps(x, TURN) == 0
    assert unwrap(x, np.zeros(x.size), TURN)[0] is x


def test_the_quality_of_a_recording_names_the_jumps() -> None:
    rng = np.random.default_rng(0)
    motors = {f"motor_setpoint_{j}": np.repeat(rng.uniform(0.0, 3.0, 40), 10) for j in (1, 2, 3)}
    roll = 0.2 * np.sin(np.arange(400) / 15.0)
    wrapped = (roll + TURN) % TURN - np.pi
    channels = {**motors, "pitch": roll, "roll": wrapped}
    recording = Recording(0.02 * np.arange(400), 0.02, channels, np.zeros(400, dtype=int))
    found = {name: channel.wraps for name, channel in assess_quality(recording).channels.items()}
    assert found["roll"] == np.count_nonzero(np.abs(np.diff(wrapped)) > np.pi)
    assert found["pitch"] == found["motor_setpoint_1"] == 0
