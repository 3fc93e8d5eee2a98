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

from softneck.identification import PAPER_EQ21, Model
from softneck.identification.linear._regression import no_base
from softneck.identification.set_membership._regressor import all_pairs_gammas, least_gammas, set_arrays
from softneck.runtime import load_functions, load_runtime

RUNTIME = "softneck.identification.set_membership._nlsm_runtime"
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
def arrays_of(rows: int) -> dict[str, np.ndarray]:
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
    return {
        "history": np.array([3.0, 2.0]),
        "drive": np.zeros((3, 2)),
        "table": PAPER_EQ21,
        "scale": np.ones(10),
        **set_arrays(points, np.full(2, GAMMA), np.full(2, EPSILON)),
        **no_base(),
    }


def model_of(rows: int) -> Model:
    """The model over `arrays_of` these points."""
    return Model(kind="nlsm", sample_time=0.02, arrays=arrays_of(rows))


def free_run(rows: int, *, compiled: bool = True, steps: int = STEPS) -> tuple[Callable[[], np.ndarray], int]:
    """Return a free run over another motion, and how many queries it makes."""
    runtime = load_runtime(RUNTIME, compiled=compiled)
    arrays = model_of(rows).block().arrays
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
    """Return the least time of this thread on the processor: a busy machine makes it wait, which is no cost of ours."""
    run()
    best = np.inf
    for _ in range(rounds):
        started = time.thread_time()
        run()
        best = min(best, time.thread_time() - started)
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


def by_numpy(how: str, points: np.ndarray, values: np.ndarray) -> Callable[[np.ndarray], tuple[float, float]]:
    """Three ways to write Eq. 19 and 20 over all points by numpy; what the tree is compared with depends on which."""
    rows = np.ascontiguousarray(points.T)
    square, total, gap = np.empty(values.size), np.empty(values.size), np.empty(values.size)

    def bounds(x: np.ndarray) -> tuple[float, float]:
        if how == "points as rows, temporaries":
            # What one writes first, and most do.
            d = np.sqrt(((rows - x) ** 2).sum(axis=1))
            return float(np.max(values - EPSILON - GAMMA * d)), float(np.min(values + EPSILON + GAMMA * d))
        if how == "points as rows, norm":
            d = np.linalg.norm(rows - x, axis=1)
            return float(np.max(values - EPSILON - GAMMA * d)), float(np.min(values + EPSILON + GAMMA * d))
        # The best we know: a column a regressor, nothing allocated.
        total[:] = 0.0
        for column, coordinate in zip(points, x, strict=True):
            np.subtract(column, coordinate, out=gap)
            np.multiply(gap, gap, out=square)
            np.add(total, square, out=total)
        np.sqrt(total, out=total)
        np.multiply(total, GAMMA, out=total)
        low, high = np.max(np.subtract(values, total, out=gap)), np.min(np.add(values, total, out=square))
        return float(low) - EPSILON, float(high) + EPSILON

    return bounds


NUMPY = ("points as rows, temporaries", "points as rows, norm", "points as columns, in place")


@pytest.mark.benchmark(group="the tree in a free run at 7,000 points beside numpy")
def test_tree_beside_numpy(benchmark: BenchmarkFixture) -> None:
    """All in one run, a round of each after a round of the others, so that a busy machine is busy for all."""
    run, queries = free_run(7_000)
    arrays = arrays_of(7_000)
    W, y, tree, frame = (arrays[name][0] for name in ("points", "values", "nodes", "frame"))
    outputs = benchmark.pedantic(run, rounds=5)
    # The same motion, from where the output lies as in the free run.
    u = motion(STEPS - 3, seed=2)
    X = np.zeros((STEPS, 10))
    for i, (source, channel, lag) in enumerate(PAPER_EQ21):
        if source > 0:
            X[3:, i] = u[4 - int(lag) : STEPS + 1 - int(lag), int(channel)]
    X[1:, 0] = outputs[:-1, 0]
    X = X[10::20]
    functions = load_functions("softneck.identification.set_membership._principal_tree_runtime")
    expected = [functions.slant_bounds(W, y, tree, frame, GAMMA, x) for x in X] + np.array([-EPSILON, EPSILON])
    plain = load_functions(RUNTIME).nlsm_bounds
    ways = {how: by_numpy(how, W, y) for how in NUMPY}
    ways["compiled, all points"] = lambda x: plain(W, y, GAMMA, EPSILON, x)
    for bounds in ways.values():
        np.testing.assert_allclose([bounds(x) for x in X], expected, rtol=0, atol=1e-12)
    best = dict.fromkeys(("tree", *ways), np.inf)
    for _ in range(7):
        best["tree"] = min(best["tree"], seconds(run, 1) / queries)
        for how, bounds in ways.items():
            best[how] = min(best[how], seconds(lambda bounds=bounds: [bounds(x) for x in X], 1) / len(X))
    for how, per_query in best.items():
        times = "" if how == "tree" else f" ({per_query / best['tree']:.0f} times the tree)"
        benchmark.extra_info[how] = f"{1e6 * per_query:.2f} us per query{times}"
        print(f"\n{how}: {benchmark.extra_info[how]}", end="")
    # Issue 5.
    assert best["tree"] < 5e-6


def principal_directions(points: np.ndarray) -> int:
    """Return how many principal directions of points (rows, n) have 99.9 % of the variance."""
    sizes = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) ** 2
    return int(np.searchsorted(np.cumsum(sizes), 0.999 * sizes.sum())) + 1


@pytest.mark.benchmark(group="the tree where points fill ten dimensions")
@pytest.mark.parametrize("rows", [7_000, 50_000])
def test_points_that_fill_ten_dimensions(benchmark: BenchmarkFixture, rows: int) -> None:
    """Nothing can be left out there: what the tree costs beside a search over all points, and how full each set is."""
    rng = np.random.default_rng(0)
    X, queries = rng.standard_normal((rows, 10)), rng.standard_normal((200, 10))
    y = next_angle(X) + SIGMA * rng.standard_normal(rows)
    known = set_arrays([(np.ascontiguousarray(X.T), y)], np.array([GAMMA]), np.array([EPSILON]))
    W, values, tree, frame = (known[name][0] for name in ("points", "values", "nodes", "frame"))
    slant = load_functions("softneck.identification.set_membership._principal_tree_runtime").slant_bounds
    plain = load_functions(RUNTIME).nlsm_bounds
    ways = {
        "tree": lambda x: np.add(slant(W, values, tree, frame, GAMMA, x), [-EPSILON, EPSILON]),
        "compiled, all points": lambda x: np.array(plain(W, values, GAMMA, EPSILON, x)),
    }
    by_tree, by_all = (np.array([bounds(x) for x in queries]) for bounds in ways.values())
    np.testing.assert_allclose(by_tree, by_all, rtol=0, atol=1e-12)
    benchmark.pedantic(lambda: [ways["tree"](x) for x in queries], rounds=3)
    for name, bounds in ways.items():
        taken = seconds(lambda bounds=bounds: [bounds(x) for x in queries]) / len(queries)
        benchmark.extra_info[name] = f"{1e6 * taken:.1f} us per query"
    sets = {"along a motion": arrays_of(7_000)["points"][0].T, "independent": X}
    benchmark.extra_info["directions"] = {name: principal_directions(points) for name, points in sets.items()}
    print(f"\n{rows} points: {benchmark.extra_info}", end="")


@pytest.mark.benchmark(group="building")
def test_building_a_million(benchmark: BenchmarkFixture) -> None:
    arrays = arrays_of(1_000_000)
    points, y = arrays["points"][0], arrays["values"][0]
    size = points.nbytes + y.nbytes

    def build() -> dict[str, np.ndarray]:
        return set_arrays([(points, y)], np.array([GAMMA]), np.array([EPSILON]))

    benchmark.pedantic(build, rounds=1)
    tracemalloc.start()
    started = time.perf_counter()
    tree = build()
    assert time.perf_counter() - started < 15.0
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    del tree
    benchmark.extra_info["peak over data"] = round(1 + peak / size, 2)
    print(f"\n{benchmark.extra_info}", end="")
    # Issue 5: with the data it is made from.
    assert size + peak < 3 * size


@pytest.mark.benchmark(group="gamma over all pairs")
@pytest.mark.parametrize("scaling", ["as it is", "output x 10", "output x 57.3", "by the spread", "noise only"])
def test_gamma_curve_of_7000(benchmark: BenchmarkFixture, scaling: str) -> None:
    arrays = arrays_of(7_000)
    points, values = arrays["points"][0].copy(), arrays["values"][0]
    if scaling.startswith("output"):
        points[0] *= float(scaling.split()[-1])
    elif scaling == "by the spread":
        points /= points.std(axis=1, keepdims=True)
    elif scaling == "noise only":
        points = np.random.default_rng(0).standard_normal(points.shape)
    epsilon = np.geomspace(3e-4, 0.5, 32) * np.ptp(values)
    gamma, _ = benchmark.pedantic(least_gammas, (points, values, epsilon), rounds=3, warmup_rounds=1)
    started = time.perf_counter()
    expected = all_pairs_gammas(points, values, epsilon[::15])[0]
    benchmark.extra_info["numpy, 3 of 32 steps [s]"] = round(time.perf_counter() - started, 2)
    # Distances in another order of sums, and what rise - epsilon cancels.
    np.testing.assert_allclose(gamma[::15], expected, rtol=1e-9)
