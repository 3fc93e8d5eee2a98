"""The low-pass filter with dead time that gives a robot's directions and time constant."""

from __future__ import annotations

import tracemalloc

import numpy as np
import scipy.signal as dsp

from softneck.core import Matrix, Vector
from softneck.identification.models._directions import Directions, _fit_low_pass

RUN, RUNS, TAU, LATE = 200, 30, 12.0, 3


def runs(noise: float) -> tuple[list[Matrix], list[Vector]]:
    """Runs of two motors, one at rest, an output far from zero, some samples missing."""
    rng = np.random.default_rng(0)
    pole, inputs, outputs = np.exp(-1.0 / TAU), [], []
    for _ in range(RUNS):
        U = np.column_stack([np.repeat(rng.uniform(-1.0, 1.0, RUN // 20), 20), np.full(RUN, 0.5)])
        delayed = np.concatenate([np.full(LATE + 1, U[0, 0]), U[: -LATE - 1, 0]])
        y = 300.0 + 2.0 * dsp.lfilter([1.0 - pole], [1.0, -pole], delayed, zi=[pole * rng.uniform(-1.0, 1.0)])[0]
        y += noise * rng.standard_normal(RUN)
        y[rng.random(RUN) < 0.1] = np.nan
        inputs.append(U)
        outputs.append(y)
    return inputs, outputs


def test_a_filter_is_found_again_whatever_state_each_run_starts_from() -> None:
    tau, weights, late = _fit_low_pass(*runs(noise=0.0))
    assert late == LATE
    # The search ends within 0.1 % of the logarithm.
    np.testing.assert_allclose(tau, TAU, rtol=2e-3)
    np.testing.assert_allclose(weights, [2.0, 0.0], atol=5e-3)


def test_the_weights_are_those_of_least_squares_over_all_rows() -> None:
    inputs, outputs = runs(noise=0.3)
    tau, weights, late = _fit_low_pass(inputs, outputs)
    pole, columns = np.exp(-1.0 / tau), np.zeros((RUN * RUNS, 2 + RUNS))
    for run, U in enumerate(inputs):
        rows = slice(RUN * run, RUN * (run + 1))
        delayed = np.concatenate([np.full(late + 1, U[0, 0]), U[: -late - 1, 0]])
        columns[rows, 0] = dsp.lfilter([1.0 - pole], [1.0, -pole], delayed, zi=[pole * U[0, 0]])[0]
        columns[rows, 1], columns[rows, 2 + run] = 1.0, pole ** np.arange(RUN)
    y = np.concatenate(outputs)
    there = np.isfinite(y)
    dense = np.linalg.lstsq(columns[there], y[there])[0]
    # Rounding of normal equations whose output is 300 times its motion.
    np.testing.assert_allclose(weights, [dense[0], 0.0], rtol=1e-9, atol=1e-12)


def test_many_runs_need_no_more_memory_than_their_rows() -> None:
    inputs, outputs = runs(noise=0.3)
    tracemalloc.start()
    _fit_low_pass(inputs, outputs)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # Three copies of inputs and output; a regressor for the start of each run would be 30 more columns.
    assert peak < 3 * 8 * 3 * RUN * RUNS + 100_000


def held(rng: np.random.Generator, low: float, high: float) -> Vector:
    """Levels of 25 samples."""
    return np.repeat(rng.uniform(low, high, 120), 25)


def lagged(u: Vector) -> Vector:
    pole = np.exp(-1.0 / TAU)
    delayed = np.concatenate([np.full(LATE + 1, u[0]), u[: -LATE - 1]])
    return np.asarray(dsp.lfilter([1.0 - pole], [1.0, -pole], delayed))


def pairs() -> tuple[Vector, Matrix]:
    """The motion of the first of two pairs of tendons, and set-points (time, 4) of two decimals."""
    rng = np.random.default_rng(3)
    u, v, c = held(rng, -12.0, 12.0), held(rng, -12.0, 12.0), held(rng, 0.0, 2.0)
    return u, np.round(np.column_stack([c + u, c + v, c - u, c - v]), 2)


def test_inputs_of_a_nonlinear_model_are_motions_and_no_rounding() -> None:
    U = pairs()[1]
    found = Directions(("x",), np.array([[0.5, 0.0, -0.5, 0.0]]), np.ones(1), learned=True)
    T = found.all_inputs(U)
    assert T.shape == (3, 4)
    # What pairs of one sum never do is in no input.
    np.testing.assert_allclose(T @ [1.0, -1.0, 1.0, -1.0], 0.0, atol=1e-3)
    assert found.all_inputs(U + np.random.default_rng(6).uniform(-3.0, 3.0, U.shape)).shape == (4, 4)


def test_rounding_of_tendons_in_pairs_of_one_sum_is_no_motion() -> None:
    """What `T1 + T3 = T2 + T4` leaves of four tendons is rounding, which had become the whole direction."""
    u, U = pairs()
    rng = np.random.default_rng(5)
    y = np.sin(lagged(u) / 10.0) + 0.003 * rng.standard_normal(u.size)
    _, weights, _ = _fit_low_pass([U], [y])
    # The sine is no line: of the other pair's and the pretension's weights a tenth is left over.
    np.testing.assert_allclose(weights / np.linalg.norm(weights), np.array([1.0, 0.0, -1.0, 0.0]) / 2**0.5, atol=0.1)


def test_a_small_motion_that_the_output_follows_is_no_rounding() -> None:
    rng = np.random.default_rng(4)
    d, c = held(rng, -0.05, 0.05), held(rng, -6.0, 6.0)
    _, weights, _ = _fit_low_pass([np.column_stack([c + d, c - d])], [lagged(d) + 1e-3 * rng.standard_normal(d.size)])
    np.testing.assert_allclose(weights, [0.5, -0.5], rtol=0.05)  # noise of a thirtieth of the motion
