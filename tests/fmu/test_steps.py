"""The timing rule: whatever the communication step, the outputs at the sample instants are the block's."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

TS = 0.02
INPUTS = ("motor_setpoint_1", "driven", "extra")
OUTPUTS = ("pitch", "measurement_valid")
PARAMETERS = {"pitch_start": 0.3, "noise_std": 0.1, "noise_seed": 5.0, "biased": 1.0}


def _grid(name: str) -> list[int]:
    """Return communication points in tenths of a sample time, to sample 40 or further."""
    if name == "irregular":
        return [0, *np.cumsum(np.random.default_rng(3).integers(1, 37, size=60)).tolist()]
    step = {"Ts": 10, "Ts/2": 5, "Ts/10": 1, "2Ts": 20, "0.7Ts": 7}[name]
    return list(range(0, 401, step))


def _rows(points: list[int], held: np.ndarray) -> np.ndarray:
    """Return the inputs that each sample before the last point reads: those set at the last point before it."""
    samples = -(-points[-1] // 10)
    return np.array([held[np.searchsorted(points, 10 * n, side="right") - 1] for n in range(samples)])


def _drive(
    fmu: Any, points: list[int], inputs: dict[str, np.ndarray], outputs: tuple[str, ...], start: float = 0.0
) -> np.ndarray:
    """Return the outputs at all points after the first."""
    seen = []
    for i, (a, b) in enumerate(itertools.pairwise(points)):
        fmu.set(**{name: column[i] for name, column in inputs.items()})
        fmu.fmu.doStep(start + a * TS / 10, (b - a) * TS / 10)
        seen.append(fmu.get(*outputs))
    return np.array(seen)


@pytest.mark.parametrize("start", [0.0, 3.7, -1.0])
@pytest.mark.parametrize("grid", ["Ts", "Ts/2", "Ts/10", "2Ts", "0.7Ts", "irregular"])
def test_a_plant_shows_sample_n_from_its_instant_on(
    grid: str, start: float, lag_fmu: Path, toys: Any, running: Any
) -> None:
    points = _grid(grid)
    held = np.random.default_rng(1).standard_normal((len(points), 3))
    held[:, 1] = held[:, 1] > -1.0
    block = toys.lag()
    state = block.initial_state(**PARAMETERS)
    _, outputs = block.run(state, _rows(points, held))
    outputs = np.vstack([state.outputs, outputs])
    with running(lag_fmu) as fmu:
        fmu.begin(start, **PARAMETERS)
        assert fmu.get(*OUTPUTS) == state.outputs.tolist()
        seen = _drive(fmu, points, dict(zip(INPUTS, held.T, strict=True)), OUTPUTS, start)
    # The same arithmetic on the same numbers: equal to the bit.
    np.testing.assert_array_equal(seen, outputs[[point // 10 for point in points[1:]]])


@pytest.mark.parametrize("grid", ["Ts", "Ts/2", "Ts/10", "2Ts", "0.7Ts", "irregular"])
def test_a_controller_answers_at_once(grid: str, controller_fmu: Path, toys: Any, running: Any) -> None:
    points = _grid(grid)
    held = 0.1 * np.random.default_rng(1).standard_normal((len(points), 2))
    block = toys.controller()
    _, outputs = block.run(block.initial_state(), _rows(points, held))
    with running(controller_fmu) as fmu:
        fmu.begin()
        assert fmu.get("motor_setpoint_1") == [0.0]
        seen = _drive(fmu, points, {"pitch_reference": held[:, 0], "pitch": held[:, 1]}, ("motor_setpoint_1",))
    # At the end of a step the last sample taken is the last one before that end.
    np.testing.assert_array_equal(seen, outputs[[-(-point // 10) - 1 for point in points[1:]]])


def test_hosts_that_add_up_their_time_stay_in_step(lag_fmu: Path, toys: Any, running: Any) -> None:
    block, u = toys.lag(), np.random.default_rng(2).standard_normal(3000)
    rows = np.column_stack([u, np.ones(3000), np.full(3000, np.nan)])
    _, outputs = block.run(block.initial_state(), rows)
    time, seen = 0.0, []
    with running(lag_fmu) as fmu:
        fmu.begin()
        for value in u:
            fmu.set(motor_setpoint_1=value)
            for _ in range(3):
                fmu.fmu.doStep(time, TS / 3)
                time += TS / 3
            seen.append(fmu.get("pitch")[0])
    np.testing.assert_array_equal(seen, outputs[:, 0])


def test_reset_brings_back_the_start(lag_fmu: Path, running: Any) -> None:
    with running(lag_fmu) as fmu:
        runs = []
        for _ in range(3):
            fmu.begin(1.0, **PARAMETERS)
            fmu.set(motor_setpoint_1=0.5)
            rows = [fmu.get("pitch")]
            for k in range(20):
                fmu.fmu.doStep(1.0 + k * TS, TS)
                rows.append(fmu.get("pitch"))
            runs.append(rows)
            fmu.fmu.terminate()
            fmu.fmu.reset()
            assert fmu.get("pitch_start", "motor_setpoint_1") == [0.0, 0.0]
    assert runs[0] == runs[1] == runs[2]


def test_outputs_follow_the_parameters_until_the_initialisation_ends(lag_fmu: Path, running: Any) -> None:
    with running(lag_fmu) as fmu:
        fmu.fmu.setupExperiment(startTime=0.0)
        fmu.fmu.enterInitializationMode()
        for value in (0.1, 0.2):
            fmu.set(pitch_start=value)
            assert fmu.get("pitch") == [value]
        fmu.fmu.exitInitializationMode()
        assert fmu.get("pitch") == [0.2]
