"""Cost of set membership; run with `pytest tests/benchmarks/test_set_membership.py --benchmark-only`.

Bounds inside a compiled free run by the tree, by compiled brute force and by vectorised numpy; their growth from
7,000 to 1,000,000 points; building; gamma over all pairs.
"""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from softneck.core import load_functions, load_runtime
from softneck.identification import PAPER_EQ21, gamma_curve
from softneck.identification._arrays import no_base
from softneck.identification._set_ground import set_arrays

RUNTIME = "softneck.identification._nlsm_runtime"
STEPS = 2000
# A little above the slope of the function below, as the knee of its curve has it, and 4 sigma of its noise.
GAMMA, EPSILON, SIGMA = 0.6, 4e-3, 1e-3


def motion(rows: int, seed: int) -> np.ndarray:
    """A slow motion of three motors (rows + 3, 3) [rad] at 20 ms; what seeds share are its frequencies."""
    rng, t = np.random.default_rng(seed), 0.02 * np.arange(rows + 3)
    tones = np.array([0.31, 0.77, 1.3, 2.1, 3.3])
    waves = [np.sin(np.outer(t, w * rng.uniform(0.97, 1.03, 3)) + rng.uniform(0, 6.3, 3)) for w in tones]
    return 0.5 * np.sum(waves, axis=0)


def next_angle(x: np.ndarray) -> np.ndarray:
    """The next output for regressors of Eq. 21 (rows, 10): a lag with a curved gain."""
    return 0.5 * x[:, 0] + 0.1 * np.sin(x[:, 1] - 0.5 * x[:, 3] - 0.5 * x[:, 5])


@cache
def arrays_of(rows: int) -> tuple[np.ndarray, ...]:
    """The arrays of a model over `rows` points of Eq. 21's ten regressors along a motion."""
    u, rng = motion(rows, seed=1), np.random.default_rng(0)
    X = np.empty((rows, 10))
    for i, (source, channel, lag) in enumerate(PAPER_EQ21):
        if source > 0:
            X[:, i] = u[3 - int(lag) : rows + 3 - int(lag), int(channel)]
    v = 0.1 * np.sin(X[:, 1] - 0.5 * X[:, 3] - 0.5 * X[:, 5])
    y = 0.0
    for k in range(rows):
        X[k, 0] = y
        y = 0.5 * y + v[k] + SIGMA * rng.standard_normal()
    values = next_angle(X) + SIGMA * rng.standard_normal(rows)
    points = [(np.ascontiguousarray(X.T), values)] * 2
    return (
        np.array([3.0]),
        np.zeros((3, 2)),
        PAPER_EQ21,
        np.ones(10),
        *set_arrays(points, np.full(2, GAMMA), np.full(2, EPSILON)).values(),
        *no_base().values(),
    )


def free_run(rows: int, *, compiled: bool = True, steps: int = STEPS) -> tuple[Callable[[], np.ndarray], int]:
    """Return a free run over another motion, and how many queries it makes."""
    runtime, arrays = load_runtime(RUNTIME, compiled=compiled), arrays_of(rows)
    U = np.full((steps, 8), np.nan)
    U[:, :3] = motion(steps - 3, seed=2)
    parameters = np.zeros(5)

    def run() -> np.ndarray:
        state, outputs = np.zeros(runtime.state_size(arrays)), np.zeros((steps, 9))
        runtime.initialise(arrays, parameters, state, np.zeros(9))
        runtime.run_steps(arrays, parameters, state, U, outputs)
        return outputs

    return run, 2 * steps


def seconds(run: Callable[[], object], rounds: int = 3) -> float:
    run()
    best = np.inf
    for _ in range(rounds):
        started = time.perf_counter()
        run()
        best = min(best, time.perf_counter() - started)
    return best


@pytest.mark.benchmark(group="free run of 2,000 steps, 4,000 queries")
@pytest.mark.parametrize("rows", [7_000, 100_000, 1_000_000])
def test_free_run_by_the_tree(benchmark: BenchmarkFixture, rows: int) -> None:
    run, queries = free_run(rows)
    run()
    outputs = benchmark.pedantic(run, rounds=5)
    assert (outputs[:, 5] < outputs[:, 6]).all()
    per_query = seconds(run) / queries
    benchmark.extra_info["us per query"] = round(1e6 * per_query, 2)
    small, _ = free_run(7_000)
    # Issue 5: 5 us at 7,000 points and at most five times that of 7,000 at a million.
    assert per_query < 5e-6 if rows == 7_000 else per_query < 5 * seconds(small) / queries


@pytest.mark.benchmark(group="free run of 2,000 steps, 4,000 queries")
def test_free_run_by_numpy(benchmark: BenchmarkFixture) -> None:
    run, queries = free_run(7_000, compiled=False)
    outputs = benchmark.pedantic(run, rounds=1)
    fast, _ = free_run(7_000)
    np.testing.assert_allclose(fast(), outputs, rtol=0, atol=1e-12)
    benchmark.extra_info["us per query"] = round(1e6 * seconds(run, 1) / queries, 1)


@pytest.mark.benchmark(group="one query at 7,000 points")
@pytest.mark.parametrize("how", ["tree", "compiled, all points", "numpy, all points", "numpy, row by row"])
def test_query(benchmark: BenchmarkFixture, how: str) -> None:
    arrays = arrays_of(7_000)
    W, y, nodes = arrays[4][0], arrays[5][0], arrays[7][0]
    X = np.ascontiguousarray(W[:, ::10].T) + 0.01
    bounds = np.zeros((len(X), 2))
    tree = load_functions("softneck.identification._tree_runtime")
    plain = load_functions(RUNTIME, compiled=how == "compiled, all points")
    rows = np.ascontiguousarray(W.T)

    def run() -> np.ndarray:
        if how == "tree":
            tree.tree_batch(W, y, nodes, GAMMA, X, bounds)
            return bounds[0]
        if how == "numpy, row by row":
            # What one writes first: points as rows, one call of norm.
            cones = [GAMMA * np.linalg.norm(rows - x, axis=1) for x in X]
            return np.array([(np.max(y - cone), np.min(y + cone)) for cone in cones])[0]
        return np.array([plain.nlsm_bounds(W, y, GAMMA, 0.0, x) for x in X])[0]

    run()
    result = benchmark.pedantic(run, rounds=3)
    benchmark.extra_info["us per query"] = round(1e6 * seconds(run, 1) / len(X), 2)
    assert tuple(result) == pytest.approx(plain.nlsm_bounds(W, y, GAMMA, 0.0, X[0]), abs=1e-12)


@pytest.mark.benchmark(group="building")
def test_building_a_million(benchmark: BenchmarkFixture) -> None:
    arrays = arrays_of(1_000_000)
    points = (arrays[4][0], arrays[5][0])
    size = points[0].nbytes + points[1].nbytes

    def build() -> dict[str, np.ndarray]:
        return set_arrays([points], np.array([GAMMA]), np.array([EPSILON]))

    started = time.perf_counter()
    built = benchmark.pedantic(build, rounds=1)
    assert time.perf_counter() - started < 15.0
    kept = sum(array.nbytes for array in built.values())
    tracemalloc.start()
    build()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    benchmark.extra_info |= {"kept over data": round(kept / size, 2), "peak over data": round(1 + peak / size, 2)}
    # Issue 5: with the data it is made from.
    assert size + peak < 3 * size


@pytest.mark.benchmark(group="gamma over all pairs")
def test_gamma_curve_of_7000(benchmark: BenchmarkFixture) -> None:
    arrays = arrays_of(7_000)
    curve = benchmark(gamma_curve, arrays[4][0], arrays[5][0])
    assert curve.epsilon.size == 32
    expected = load_functions("softneck.identification._cones_runtime").least_gammas(
        arrays[4][0], arrays[5][0], curve.epsilon[::15], np.zeros((3, 2))
    )
    np.testing.assert_allclose(curve.gamma[::15], expected, rtol=1e-12)
